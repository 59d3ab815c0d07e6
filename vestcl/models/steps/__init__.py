"""What happens between the networks, the arrows of the paper's figure: encode, lift, move, render, perceive."""
