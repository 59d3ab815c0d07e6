"""How the camera and the objects of a scene move."""
