"""VIMA-Gato."""
