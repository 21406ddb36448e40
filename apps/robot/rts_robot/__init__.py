"""Robots: parts of a URDF, moved by joints, and cameras calibrated by masks. An application of `rts`."""

import rts as rts  # Before torch, whose idle threads it asks not to spin.
from rts_robot.calibration import Calibration, calibrate
from rts_robot.robot import Robot, load_urdf

__all__ = ["Calibration", "Robot", "calibrate", "load_urdf"]
