"""How a trained model is run: loaded, timed by stage, by preset, without what a scene does not need."""
