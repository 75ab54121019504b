"""Videos: H.264 encoding, prompt strips, recorded episodes and their clips."""
