"""For commands of one's own: the camera that the library's commands have."""

from rts.cli.views import default_camera

__all__ = ["default_camera"]
