"""Color: the sRGB transfer function, the palette of object IDs, and recoloring."""
