"""Summary statistics of events with a physical reading, and the distance between two sets of them."""
