"""The box's hardware as source: one description in Python, and everything generated from it and checked against it."""
