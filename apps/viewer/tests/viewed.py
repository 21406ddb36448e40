"""Small meshes, free ports, and a page that is closed in the end."""

import contextlib
import socket

import numpy as np
import rts_viewer
import trimesh

import rts

RED, GREEN = (0.8, 0.02, 0.02), (0.02, 0.6, 0.05)


def free_port():
    with socket.socket() as tried:
        tried.bind(("127.0.0.1", 0))
        return tried.getsockname()[1]


@contextlib.contextmanager
def watching(**options):
    watch = rts_viewer.Watch(**{"port": free_port(), **options})
    try:
        yield watch
    finally:
        watch.close()


def ball(color=RED, cuts=2):
    """Vertices, faces and colours of a sphere of radius one."""
    sphere = trimesh.creation.icosphere(cuts)
    vertices = np.asarray(sphere.vertices, np.float32)
    return vertices, np.asarray(sphere.faces), np.tile(np.float32(color), (len(vertices), 1))


def view(eye, color=GREEN, size=(240, 320)):
    """A view from a point towards the origin, of one colour all over."""
    camera = rts.Camera.look_at(eye, (0, 0, 0), aspect=size[1] / size[0])
    return rts.View(camera, np.tile(np.float32(color), (*size, 1)))
