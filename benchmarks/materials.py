"""Prints the table of docs/guides/materials.md: what is known of each silicone, and what follows for its Young's modulus."""

from __future__ import annotations

from femsense.io.materials import SILICONES


def main() -> None:
    """Print one row for each silicone, then one for each way to a modulus."""
    print("| name | Shore | density, kg/m³ | E used, kPa | spread, kPa |\n|---|---|---|---|---|")
    for material in SILICONES:
        low, high = (f"{value / 1e3:.0f}" for value in material.spread_pa)
        density = "–" if material.density_kg_m3 is None else f"{material.density_kg_m3:.0f}"
        spread = "one source" if len(material.moduli) == 1 else f"{low} – {high}"
        print(f"| `{material.name}` | {material.shore} | {density} | {material.young_modulus_pa / 1e3:.0f} | {spread} |")
    print("\n| silicone | way | E, kPa | source |\n|---|---|---|---|")
    for material in SILICONES:
        for modulus in material.moduli:
            print(f"| {material.name} | {modulus.way} | {modulus.young_modulus_pa / 1e3:.0f} | {modulus.source} |")
        print(f"| {material.name} | hardness, density | | {material.source} |")


if __name__ == "__main__":
    main()
