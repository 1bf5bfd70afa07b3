"""From a scene to events: the sensor, its file, its pixels and its readout."""
