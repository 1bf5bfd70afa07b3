"""What a model lacks: comparing it with a measurement, trying effects, saying what was found."""
