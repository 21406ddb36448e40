"""Radiance fields: networks of position and direction, drawn as volumes or as surface light fields."""
