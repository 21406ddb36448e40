"""A small arm: a URDF with meshes in a folder, as a package of ROS has them."""

from __future__ import annotations

import numpy as np
import trimesh

import rts

JOINTS = ("shoulder", "elbow", "slide", "finger")
UPPER, FORE = 0.5, 0.4

URDF = """<?xml version="1.0"?>
<robot name="arm">
  <material name="red"><color rgba="0.8 0.1 0.1 1"/></material>
  <link name="base"><visual><origin xyz="0.06 0.02 -0.05"/><geometry><box size="0.34 0.22 0.1"/></geometry>
    <material name="red"/></visual></link>
  <link name="upper"><visual><geometry><mesh filename="package://arm_description/meshes/upper.stl"/></geometry>
    </visual></link>
  <link name="fore"><visual><geometry><mesh filename="package://arm_description/meshes/fore.obj" scale="1 1 0.5"/>
    </geometry></visual></link>
  <link name="hand"><visual><geometry><mesh filename="meshes/hand.dae"/></geometry></visual></link>
  <link name="tip"/>
  <link name="left"><visual><origin xyz="0.06 0 0"/><geometry><cylinder radius="0.02" length="0.1"/></geometry>
    </visual></link>
  <link name="right"><visual><origin xyz="0.06 0 0"/><geometry><sphere radius="0.03"/></geometry></visual></link>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 0 2"/>
    <limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
  <joint name="elbow" type="continuous"><parent link="upper"/><child link="fore"/><origin xyz="0.5 0 0"/>
    <axis xyz="0 1 0"/></joint>
  <joint name="slide" type="prismatic"><parent link="fore"/><child link="hand"/><origin xyz="0.4 0 0"/>
    <axis xyz="1 0 0"/><limit lower="0" upper="0.2" effort="1" velocity="1"/></joint>
  <joint name="flange" type="fixed"><parent link="hand"/><child link="tip"/><origin xyz="0 0 0.1" rpy="0 0 1.5707963"/>
    </joint>
  <joint name="finger" type="prismatic"><parent link="tip"/><child link="left"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="0.1" effort="1" velocity="1"/></joint>
  <joint name="other" type="prismatic"><parent link="tip"/><child link="right"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/><mimic joint="finger" multiplier="-2" offset="0.01"/></joint>
</robot>
"""


def written(folder):
    """The URDF of the arm, in folder/arm_description."""
    package = folder / "arm_description"
    (package / "meshes").mkdir(parents=True)
    box, move = trimesh.creation.box, trimesh.transformations.translation_matrix
    box((UPPER, 0.1, 0.12), move((UPPER / 2, 0, 0.03))).export(package / "meshes/upper.stl")
    box((FORE, 0.07, 0.16), move((FORE / 2, 0, 0))).export(package / "meshes/fore.obj")
    box((0.05, 0.2, 0.06)).export(package / "meshes/hand.dae")
    path = package / "arm.urdf"
    path.write_text(URDF)
    return path


SIZE = (60, 80)
CAMERA = rts.Camera.look_at((1.6, -1.5, 1.0), (0.3, 0.1, 0.0), (0, 0, 1), fov_y=45, aspect=4 / 3)
VALUES = np.array([[0.2, -0.5, 0.02, 0.01], [1.1, 0.4, 0.1, 0.05], [-0.5, -1.2, 0.15, 0.03], [0.7, -1.6, 0.0, 0.08]])


def area_masks(robot, values=VALUES, camera=CAMERA, size=SIZE, samples=4):
    """Masks: the share of samples x samples points of each pixel that the robot covers."""
    fine = size[0] * samples, size[1] * samples
    masks = []
    for q in values:
        hard = np.asarray(rts.render(robot.parts(q), camera, fine, splatter="none", layers=1))[..., 3]
        masks.append(hard.reshape(size[0], samples, size[1], samples).mean(axis=(1, 3)))
    return np.array(masks)
