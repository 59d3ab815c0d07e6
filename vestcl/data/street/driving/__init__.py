"""How cars drive on the procedural street: courses, profiles of speed, roads, traffic."""
