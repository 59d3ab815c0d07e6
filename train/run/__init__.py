"""A training run: losses, optimiser steps, checkpoints, resuming, several processes, logs."""
