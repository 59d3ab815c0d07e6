"""How a trained model is run: loaded, timed by stage, by preset, with conditional computation."""
