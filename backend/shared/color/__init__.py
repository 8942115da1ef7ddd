"""Colors: sRGB and linear light, one color for each object ID, and changes of color."""
