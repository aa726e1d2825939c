"""The box's hardware as a source: one description in Python, and everything that is made of it and checked against it."""
