"""Commands that train a large reconstruction in cells: `split`, `train-cell` and `merge`."""
