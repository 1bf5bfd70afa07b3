"""Fitting a sensor's parameters to a measurement: many models at once, on some pixels."""
