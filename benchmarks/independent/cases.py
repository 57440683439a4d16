"""The cases: which robot, camera, control and touches; everything else is drawn from the seed."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Touch:
    """One touch."""

    kind: str = "ball"
    """"ball", "rod" or "plate"."""
    hidden: bool = False
    """Out of the camera's sight."""
    tangent: float = 0.0
    """Tangential force over normal force."""
    slide_m: float = 0.0
    """How far it slides over its frames [m]."""
    first: int = 0
    """Its first frame, counted from the first touched one."""
    scale: float = 1.0
    """How many times larger the object is than those that are drawn."""


@dataclass(frozen=True)
class Case:
    """One recording."""

    name: str
    robot: str
    touches: tuple[Touch, ...]
    control: str = "tension"
    camera: str = "stereo"
    distance_m: float = 0.35
    images: bool = False
    """Depth images in place of clouds."""
    jump: bool = False
    """All of the force at once, and a jump of the inputs."""
    zero: str = "absolute"
    declared_noise: bool = False
    tool: bool = False
    """The touching ball is declared in [[tools]]."""
    hard: bool = False
    """Three times the dropouts, more flying pixels."""
    colors: bool = True
    """Whether the camera has colours."""
    released: tuple[int, ...] = ()
    """Of the touched frames, those in which the objects have left again and hover beside the robot."""
    calm: int = 0
    """So many frames in place of the touched ones, in which the objects hover beside the robot and the inputs swing."""
    near_clamp: bool = False
    """Touches lie near the clamp, and move the body little."""
    bare: bool = False
    """Nothing stands around the robot: the camera sees no table."""
    nudges: tuple[tuple[float, float], ...] = ()
    """Shift [m] and turn about its middle [rad] of the camera, one a frame after the free ones; only there, into a direction of its own."""


FREE, TOUCHED, AFTER = 6, 10, 2
_TURNS = tuple(math.radians(angle) for angle in (0.2, 0.5, 1.0, 2.0))
_SHIFTS = (0.0005, 0.001, 0.002, 0.003, 0.005)
DIFFERENT_NUDGES = ((0.0, 0.0), *((shift, 0.0) for shift in _SHIFTS), *((0.0, turn) for turn in _TURNS))
NUDGES = 2 * DIFFERENT_NUDGES
SOME_NUDGES = (*DIFFERENT_NUDGES, (0.0, 0.0), (0.0, 0.0))

CASES = (
    Case("bar-normal", "bar", (Touch(),)),
    Case("bar-tangential", "bar", (Touch(tangent=0.8),), "displacement", "tof", images=True, declared_noise=True),
    Case("bar-hidden", "bar", (Touch(hidden=True),), declared_noise=True),
    Case("bar-jump", "bar", (Touch(),), "displacement", jump=True, hard=True),
    Case("arm-rod", "arm", (Touch("rod"),), "tension", "stereo", 0.6, images=True, zero="unknown"),
    Case("arm-two", "arm", (Touch(), Touch("plate", first=3)), "displacement"),
    Case("arm-slide", "arm", (Touch(tangent=0.3, slide_m=0.02),), camera="tof", declared_noise=True, tool=True),
    Case("arm-hidden", "arm", (Touch(hidden=True),), "displacement", "tof", 0.6),
    Case("diamond-normal", "diamond", (Touch(),), declared_noise=True, tool=True),
    Case("diamond-three", "diamond", (Touch(), Touch("rod", first=2), Touch(first=4)), "tension", "tof", images=True),
    Case("diamond-far", "diamond", (Touch(tangent=0.5),), "displacement", "stereo", 0.7, hard=True),
    Case("pad-normal", "pad", (Touch(),)),
    Case("pad-plate", "pad", (Touch("plate"),), camera="tof", images=True, declared_noise=True),
    Case("pad-slide", "pad", (Touch(tangent=0.3, slide_m=0.012),), camera="stereo", distance_m=0.5, hard=True),
    Case("slab-gray", "slab", (Touch(scale=1.5),), camera="tof", distance_m=0.45, images=True, colors=False),
    Case("bar-gray", "bar", (Touch(),), colors=False),
    Case("arm-gray", "arm", (Touch(),), "displacement", colors=False),
    Case("slab-rod", "slab", (Touch("rod"),), "displacement", "tof", 0.3, declared_noise=True),
    Case("post-two", "post", (Touch(scale=0.6), Touch(first=4)), "displacement", "stereo", 0.3),
    Case("post-plate", "post", (Touch("plate", scale=1.4),), "tension", "stereo", 0.4, images=True, colors=False),
    Case("bar-release", "bar", (Touch(),), colors=False, released=(3, 4, 8)),
    Case("arm-release", "arm", (Touch(),), "displacement", colors=False, released=(3, 4, 8)),
    Case(
        "slab-release", "slab", (Touch(scale=1.5),), camera="tof", distance_m=0.45, images=True, colors=False, released=(3, 4, 8)
    ),
    Case("bar-calm", "bar", (Touch(),), calm=120),
    Case("arm-calm", "arm", (Touch("rod"),), "displacement", "tof", 0.5, images=True, calm=120),
    Case("post-calm", "post", (Touch("plate"),), "tension", "stereo", 0.35, hard=True, calm=120),
    *(
        Case(f"{name}-nudged", name, (), control, camera, distance, calm=len(NUDGES), nudges=NUDGES)
        for name, control, camera, distance in (
            ("bar", "tension", "stereo", 0.35),
            ("arm", "displacement", "tof", 0.5),
            ("post", "tension", "stereo", 0.35),
            ("slab", "displacement", "tof", 0.4),
        )
    ),
    *(
        Case(f"{name}-touched-nudged", name, (Touch(),), control, camera, distance, nudges=SOME_NUDGES)
        for name, control, camera, distance in (
            ("bar", "tension", "stereo", 0.35),
            ("arm", "displacement", "tof", 0.5),
            ("post", "tension", "stereo", 0.35),
            ("slab", "displacement", "tof", 0.4),
        )
    ),
    *(
        Case(f"{name}-clamp{'-hidden' * hidden}", name, (Touch(hidden=hidden),), control, camera, distance, near_clamp=True)
        for name, control, camera, distance in (
            ("bar", "tension", "stereo", 0.35),
            ("arm", "displacement", "tof", 0.5),
            ("post", "tension", "stereo", 0.35),
            ("slab", "displacement", "tof", 0.4),
        )
        for hidden in (False, True)
    ),
)
