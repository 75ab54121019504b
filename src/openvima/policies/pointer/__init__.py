"""The pointer models: nano and small."""
