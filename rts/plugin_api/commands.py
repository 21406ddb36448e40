"""For commands of one's own: the camera that the library's commands have."""

from rts.cli.default_camera import default_camera

__all__ = ["default_camera"]
