"""Linear tetrahedra that make a body too stiff."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from femsense import block_mesh
from femsense.fem.body import make_body
from femsense.fem.mesh import to_quadratic
from femsense.model.linear_elements import excess_stiffness, warn_of_linear_elements
