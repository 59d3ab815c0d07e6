"""The networks, the boxes of the paper's figure: encoder, ego-motion, object motion, refinement."""
