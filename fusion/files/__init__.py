"""What is read: walks from tables, and their faults."""
