"""Views: pictures with the cameras that took them, a file for each format."""
