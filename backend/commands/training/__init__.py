"""Commands for training and its results: train, render, evaluate, report."""
