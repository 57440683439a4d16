"""Silicones that soft robots are cast from: hardness, density and Young's modulus, each with its source.

Young's modulus is that of small strains. Data sheets do not contain it; it is derived in four ways:

    measured   E = 3 s / (λ − λ⁻²) from the engineering stress s of a tensile test at a stretch λ (incompressible neo-Hookean);
    bulletin   the same from the vendor's "100 % modulus", the stress at λ = 2;
    fitted     E = 6 C₁ of a published Yeoh fit, or what a paper states;
    hardness   E = 98.1 kPa (56 + 7.66 S) / (0.137505 (254 − 2.54 S)) from Shore A hardness S (Gent 1958).

`young_modulus_pa` is the geometric mean of the lowest and highest published value, which are the spread. It is an initial guess: the
modulus depends on cure, batch, age, thinner and strain rate, and is estimated from a recording (effect `stiffness`).
"""

from __future__ import annotations

from dataclasses import dataclass

from femsense.core.errors import InputError

PSI = 6894.757
"""Pascal in a pound per square inch."""
POISSON_RATIO = 0.49
"""Of a named silicone where the robot declares none: as incompressible as the elements like it (real ones are above 0.499)."""

TENSILE = "tensile test at 450 mm/min, Soft Robotics Materials Database (Maréchal et al., Soft Robotics 2021)"
SMOOTH_ON = "Smooth-On technical bulletin of the series (7 days at 23 °C), as quoted in public design notes"
WACKER = "Wacker data sheet (24 h at 23 °C), as quoted in a public design note"
GENT = "Shore A by Gent 1958"


@dataclass(frozen=True, eq=False, slots=True)
class Modulus:
    """One way to a small-strain Young's modulus."""

    young_modulus_pa: float
    """[Pa]."""
    way: str
    """The measurement, and its conversion into a modulus."""
    source: str


@dataclass(frozen=True, eq=False, slots=True)
class Silicone:
    """A castable silicone."""

    name: str
    """As in `[material] name`."""
    shore: str
    """Hardness as the vendor gives it."""
    density_kg_m3: float | None
    """[kg/m³]; None where no source was found."""
    moduli: tuple[Modulus, ...]
    source: str
    """Of hardness and density."""

    @property
    def spread_pa(self) -> tuple[float, float]:
        """Lowest and highest published value [Pa]."""
        values = [modulus.young_modulus_pa for modulus in self.moduli]
        return min(values), max(values)

    @property
    def young_modulus_pa(self) -> float:
        """Geometric mean of lowest and highest [Pa]."""
        low, high = self.spread_pa
        return float((low * high) ** 0.5)


def neo_hookean_modulus(stress_pa: float, stretch: float) -> float:
    """Return E = 3 μ [Pa] of an incompressible neo-Hookean bar that carries an engineering stress [Pa] at a stretch [1]."""
    return 3.0 * stress_pa / (stretch - stretch**-2)


def hardness_modulus(shore_a: float) -> float:
    """Return E [Pa] for a Shore A hardness (Gent, Rubber Chemistry and Technology 31, 896, 1958)."""
    return 98.1e3 * (56.0 + 7.66 * shore_a) / (0.137505 * (254.0 - 2.54 * shore_a))


def _tensile(kpa_at_25: float, kpa_at_50: float, kpa_at_100: float) -> tuple[Modulus, ...]:
    stresses = ((1.25, kpa_at_25), (1.5, kpa_at_50), (2.0, kpa_at_100))
    return tuple(
        Modulus(neo_hookean_modulus(1e3 * s, stretch), f"measured, {s:g} kPa at {100 * (stretch - 1):.0f} % strain", TENSILE)
        for stretch, s in stresses
    )


def _bulletin(psi: float) -> tuple[Modulus, ...]:
    return (Modulus(neo_hookean_modulus(psi * PSI, 2.0), f"bulletin, {psi:g} psi at 100 % strain", SMOOTH_ON),)


def _hardness(shore_a: float) -> tuple[Modulus, ...]:
    return (Modulus(hardness_modulus(shore_a), f"hardness, Shore A {shore_a:g}", GENT),)


SILICONES = (
    Silicone("ecoflex-00-30", "00-30", 1070.0, (*_tensile(8.56, 16.89, 29.72), *_bulletin(10.0)), SMOOTH_ON),
    Silicone("ecoflex-00-50", "00-50", 1070.0, (*_tensile(12.26, 22.78, 40.95), *_bulletin(12.0)), SMOOTH_ON),
    Silicone("dragon-skin-10", "10 A", 1070.0, (*_tensile(26.43, 53.00, 112.96), *_bulletin(22.0)), SMOOTH_ON),
    Silicone("dragon-skin-20", "20 A", 1080.0, (*_tensile(72.15, 151.07, 318.36), *_bulletin(49.0)), SMOOTH_ON),
    Silicone("dragon-skin-30", "30 A", 1080.0, (*_tensile(110.87, 213.92, 437.12), *_bulletin(86.0)), SMOOTH_ON),
    Silicone("smooth-sil-940", "40 A", None, _hardness(40.0), "hardness in the name and in vendors' listings"),
    Silicone("smooth-sil-945", "45 A", None, _hardness(45.0), "hardness in the name and in vendors' listings"),
    Silicone("smooth-sil-950", "50 A", None, _hardness(50.0), "hardness in the name"),
    Silicone(
        "sylgard-184",
        "44–54 A",
        None,
        (
            Modulus(1.32e6, "fitted, 10:1, cured at 25 °C", "Johnston et al., J. Micromech. Microeng. 2014"),
            Modulus(2.97e6, "fitted, 10:1, cured at 200 °C", "Johnston et al., J. Micromech. Microeng. 2014"),
        ),
        "Johnston et al. 2014, by temperature of cure",
    ),
    Silicone(
        "elastosil-m4601",
        "28 A",
        1130.0,
        (
            Modulus(6 * 0.11e6, "fitted, Yeoh C₁ = 0.11 MPa", "coefficients used with Abaqus in published soft actuators"),
            *_hardness(28.0),
        ),
        WACKER,
    ),
)
"""Published values. Measured stresses are read from the database's curves, engineering stress over crosshead strain."""


def silicone(name: str) -> Silicone:
    """Return a silicone by name, such as "ecoflex-00-30" (capitals, blanks and underscores do not matter).

    Raises:
        InputError: no such material; it lists the known ones.
    """
    known = {material.name: material for material in SILICONES}
    key = "-".join(name.lower().replace("_", " ").replace("-", " ").split())
    if key not in known:
        raise InputError("unknown material", where="material.name", found=repr(name), expected=" | ".join(known))
    return known[key]
