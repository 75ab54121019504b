"""Augmentation, one small transform a file.

- `demonstrations.py` lists those of demonstrations; `false_positives.py` works on their batches.
- Scenes of contrastive pretraining: `appearance_randomization.py`, `hard_negatives.py`, `rearranged_view.py`,
  `grayscale.py`.
- Its crops: `horizontal_flip.py`, `occlusion.py`, `box_jitter.py`, `channel_mixing.py`.
"""
