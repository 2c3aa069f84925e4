"""Sources of frames behind one small protocol, `toftrack.devices.base.Device`."""
