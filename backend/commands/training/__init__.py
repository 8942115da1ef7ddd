"""Commands around a training: train, render, evaluate, report."""
