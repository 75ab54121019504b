"""Contrastive pretraining of the crop encoder: rendered pairs, the losses, the stage."""
