"""Frames of a robot, drawn by MuJoCo without a display.

`MUJOCO_GL` decides by what: `egl` or `osmesa`. A driver at fault may end the whole process, so
draw in a process that may be lost.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from codetr_ros.simulation.environments import Environment, TaskError

Frame = NDArray[np.uint8]
"""An image (height, width, 3)."""


class Drawing:
    """Draws the present state of an environment. A context manager.

    The camera is the first of the model, which follows the robot in the tasks with a name. Where
    the model has none, it looks from the side at all that can move.

    Args:
        environment: an environment of MuJoCo.
        width, height: of a frame [pixels].

    Raises:
        TaskError: the environment is not of MuJoCo.
        Exception: there is no way to draw here; of which kind depends on the driver.
    """

    def __init__(self, environment: Environment, width: int, height: int) -> None:
        import mujoco

        physics = environment.physics()
        if physics is None:
            raise TaskError(f'task {environment.name!r} is not of MuJoCo: it cannot be drawn')
        model, self._data = physics
        self._renderer = mujoco.Renderer(model, height, width)
        self._camera: Any = 0
        self._distance = 0.0
        if not model.ncam:
            self._camera = mujoco.MjvCamera()
            self._camera.azimuth, self._camera.elevation = 90.0, -10.0
        # geometries of the world's own body never move: floor, rail
        self._moving = np.flatnonzero(model.geom_bodyid > 0)
        self._sizes = model.geom_rbound[self._moving]

    def frame(self) -> Frame:
        """The present state as an image (height, width, 3)."""
        if self._camera and len(self._moving):
            places = self._data.geom_xpos[self._moving]
            self._camera.lookat[:] = (places.min(0) + places.max(0)) / 2
            away = np.linalg.norm(places - self._camera.lookat, axis=1) + self._sizes
            # once, so that frames show the robot in one size
            self._distance = self._distance or 3.0 * float(away.max())
            self._camera.distance = self._distance
        self._renderer.update_scene(self._data, self._camera)
        image: Frame = self._renderer.render()
        return image

    def __enter__(self) -> 'Drawing':
        return self

    def __exit__(self, *error: object) -> None:
        self._renderer.close()
