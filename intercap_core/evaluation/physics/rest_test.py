"""Rest test: an object that is not held is released at its fitted pose and simulated.

A correct pose on its support stays where it is. The displacement of the centre of mass over
:data:`RELEASED_FRAMES` frames is therefore a measure of the pose's error that needs no truth.
The idea and the number of frames are those of HUMOTO (Lu et al., ICCV 2025), which releases all
objects of a scene in PyBullet, also those that a person holds; its figures are not comparable.

The support is a horizontal plane: the floor or a level piece of furniture (:mod:`.supports`). A
rigid body touches a plane only with its convex hull. The hull of the mesh as collision shape is
therefore exact, and a decomposition into convex pieces would change nothing.

Contact has MuJoCo's default parameters (documentation, "XML reference", geom): sliding friction 1,
time constant 20 ms, damping ratio 1. At rest, an object sinks in by 0.1 to 0.4 mm.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from intercap_core.geometry.rigid.mesh import ObjectMesh

RELEASED_FRAMES = 35  # HUMOTO, section "Robotics and Embodied AI" of its project page
GRAVITY = 9.81  # m/s^2, MuJoCo's default
EXTRA = "intercap-core[physics]"


def missing_library() -> str:
    """Why the rest test cannot run: names the extra to install; "" = MuJoCo is installed."""
    try:
        import mujoco  # noqa: F401
    except ImportError:
        return f"physics needs the package mujoco: pip install '{EXTRA}'"
    return ""


class FallingBody:
    """A rigid body of uniform density above the plane z = 0, which gravity pulls along -z."""

    def __init__(self, mesh: ObjectMesh) -> None:
        """Compile the MuJoCo model; ``mesh`` is closed."""
        import mujoco
        import trimesh

        solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        centre = mesh.centre_of_mass
        # principal moments of 1 kg; motion under gravity does not depend on the mass
        moments, axes = np.linalg.eigh(np.asarray(solid.moment_inertia) / solid.volume)
        axes[:, 0] *= np.sign(np.linalg.det(axes))
        self.hull = np.asarray(solid.convex_hull.vertices, np.float64)
        self._object_from_body = np.eye(4)
        self._object_from_body[:3, :3], self._object_from_body[:3, 3] = axes, centre
        spec = mujoco.MjSpec()
        shape = spec.add_mesh(name="hull")
        shape.uservert = ((self.hull - centre) @ axes).ravel()
        shape.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
        plane = mujoco.mjtGeom.mjGEOM_PLANE
        spec.worldbody.add_geom(name="support", type=plane, size=[0, 0, 1])
        body = spec.worldbody.add_body(name="object", explicitinertial=True)
        body.mass, body.inertia = 1.0, moments
        body.add_freejoint()
        body.add_geom(name="hull", type=mujoco.mjtGeom.mjGEOM_MESH, meshname="hull")
        self._model: Any = spec.compile()
        self._data: Any = mujoco.MjData(self._model)

    def displacement(self, pose: np.ndarray, fps: float) -> float:
        """Distance from the released to the final centre of mass after ``RELEASED_FRAMES``, metres.

        Args:
            pose: (4, 4) transform from the object's frame to one with the support at z = 0.
            fps: frames per second of the recording.
        """
        import mujoco

        released = pose @ self._object_from_body
        data, model = self._data, self._model
        mujoco.mj_resetData(model, data)
        data.qpos[:3] = released[:3, 3]
        mujoco.mju_mat2Quat(data.qpos[3:], released[:3, :3].ravel())
        for _ in range(round(RELEASED_FRAMES / fps / model.opt.timestep)):
            mujoco.mj_step(model, data)
        return float(np.linalg.norm(data.qpos[:3] - released[:3, 3]))

    def gap(self, poses: np.ndarray) -> np.ndarray:
        """Signed distance (T,) of the collision shape from z = 0, metres; negative = below.

        ``poses``: (T, 4, 4) transforms from the object's frame.
        """
        return (poses[:, 2, :3] @ self.hull.T).min(axis=1) + poses[:, 2, 3]
