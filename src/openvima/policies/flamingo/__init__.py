"""VIMA-Flamingo."""
