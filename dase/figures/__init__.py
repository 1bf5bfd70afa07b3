"""Pictures of events, findings and trainings, and the pages they stand on."""
