"""Augmentation: of prompts and demonstrations in training, of scenes and crops in contrastive pretraining."""
