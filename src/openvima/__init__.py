"""Multimodal-prompt robot manipulation: a fast, deterministic VIMA-Bench and the VIMA policy family."""

__version__ = "0.1.0"
