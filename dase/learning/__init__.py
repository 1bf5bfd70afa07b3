"""Learning thresholds from recordings that are paired with nothing."""
