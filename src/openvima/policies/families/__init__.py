"""The four members of the family, in the seven published sizes and one that trains on a processor.

Each file shows what its member has of its own; the rest is in `common`.
"""
