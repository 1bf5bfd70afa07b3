"""Built-in sensors, one TOML file each."""
