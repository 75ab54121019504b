"""Augmentation, one small transform a file.

`demonstrations.py` lists those of demonstrations. `false_positives.py` works on their batches, `occlusion.py`
on the crops of contrastive pretraining.
"""
