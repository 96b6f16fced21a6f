"""Camera poses of a rig without given poses (`intercap calibrate`).

Terms: a *set* is a frame set by the recordings' clocks. A *corner* is a point of a calibration
board. A *lifted* joint is a keypoint at the depth measured around its pixel.
"""
