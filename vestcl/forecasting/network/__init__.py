"""Forecasts by a trained network: its input, the forecast, the test of its parts on frames already seen."""
