"""truearm: measure where a robot arm really is, identify its kinematic parameters, correct it."""

__version__ = "0.1.0"
