"""Signatures: effects that a recording shows by itself, without a scene and without a model."""
