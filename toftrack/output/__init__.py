"""What leaves the tracker as numbers: results, streams, smoothing."""
