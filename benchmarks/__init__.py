"""Accuracy against independent truth and time as a ratio against peers, one table each."""
