"""Objects, textures, partitions, and the asset packs that give them shape."""
