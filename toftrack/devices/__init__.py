"""Sources of frames, all of them a `toftrack.devices.base.BaseDevice`."""
