"""Forecasts of a whole drive: each N-th frame of clips, scored against what then happened, and shown in one video.

OUT/drive.mp4                      seen | forecast | truth | error, a row per view, at natural speed
OUT/scores.csv                     a line per frame, view, method and step
OUT/drive.json                     what was asked for; a run that asks for something else is refused
OUT/frames/001_CLIP/000012.jpg     an image of the video, kept as it comes
OUT/frames/001_CLIP/000012.csv     its lines of scores.csv, written last: where it is, the frame is complete
"""
