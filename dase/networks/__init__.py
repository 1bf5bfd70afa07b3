"""The network of learned thresholds, and the file of its weights."""
