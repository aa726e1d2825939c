"""The version of truearm: that of firmware and image."""

from truearm_wire.version import VERSION as VERSION
