"""From a clip to future frames in any camera: geometric, by a network, by baselines; results and their files."""
