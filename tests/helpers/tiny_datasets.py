"""A data set that is made in a moment."""

from dase.datasets.generate import DatasetJob

JOB = DatasetJob(
    images="builtin", sensor="[threshold]\n", sequences=3, width=16, height=12, duration=0.05, regime="slow"
)
"""Three sequences of a photograph that hardly moves."""
