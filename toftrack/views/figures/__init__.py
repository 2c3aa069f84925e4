"""Charts and contact sheets of finished runs, pose spaces and calibrations."""
