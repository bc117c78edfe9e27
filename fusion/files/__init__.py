"""What is read: walks from tables, their faults, and the folder that results are written to."""
