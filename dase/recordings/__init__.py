"""Recordings of cameras: opening them, their statistics, and what looks odd in them."""
