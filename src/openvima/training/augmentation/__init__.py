"""Augmentation: of prompts and demonstrations in training, of scenes in contrastive pretraining."""
