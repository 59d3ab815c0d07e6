"""How good forecasts are, window by window: `vestcl bench forecast` and `python -m train.evaluate` compute the same
scores.

A window has frames t-1 and t in sight, and t+1 to t+steps as truth. Images and truth are resized to the size that is
scored, and quantised to 8 bit.
"""
