"""What the compute process and Blender's process share. Standard library and NumPy only."""
