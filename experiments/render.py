"""The picture in the README: `MUJOCO_GL=egl python experiments/render.py docs/arm.png` (needs OpenGL)."""

import sys
from pathlib import Path

import cv2
import mujoco
import numpy as np

from arm5dof.arm import load_arm

POSE = np.radians([18, 6, 75, -80, -52])


def main(path: Path) -> None:
    loaded = load_arm("reach.xml")
    model, data = loaded.mj_model, mujoco.MjData(loaded.mj_model)
    data.qpos[loaded.qpos] = POSE
    data.qpos[len(POSE) :] = 0.02
    mujoco.mj_kinematics(model, data)
    data.mocap_pos[0] = data.site("grasp").xpos + np.array([0.03, -0.02, -0.05])
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, 600, 900) as renderer:
        renderer.update_scene(data, "front")
        cv2.imwrite(str(path), cv2.cvtColor(renderer.render(), cv2.COLOR_RGB2BGR))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
