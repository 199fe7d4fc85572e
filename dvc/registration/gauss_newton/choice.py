"""How strongly a Gauss-Newton registration smoothed, and why."""

from dataclasses import asdict, dataclass

from dvc.registration.engine import Regularisation
from dvc.registration.gauss_newton.level import Weights

_RIGID = {False: "bone", True: "skin"}  # whose strain the weight "rigidity" is of, by `at_interfaces`
_ASKED = 0.04  # the change of volume that a hundredth of the soft tissue exceeds: between loads and swelling


@dataclass(frozen=True, slots=True)
class Choice(Regularisation):
    """The prior's weights that were used, and why.

    Each weight that was tried stands beside the mean square residual of the voxels left out, over that of the best.
    `asked` is the change of volume that a hundredth of the soft tissue exceeds if only its gradient is held; None where
    the weight of the change of volume was fixed beforehand. `in_bone` is the displacement (rms, mm) and the 95th
    percentile of the maximum shear in the bone, of the smooth displacement that came before one with a rigid bone.
    """

    weights: Weights
    rule: str
    tried: tuple[tuple[float, float], ...] = ()
    tried_in_skin: tuple[tuple[float, float], ...] = ()
    at_interfaces: bool = False
    asked: float | None = None
    in_bone: tuple[float, float] | None = None

    @property
    def frees_volume(self) -> bool:
        """Whether the images ask for a change of volume, so that only its gradient was held."""
        return self.asked is not None and self.asked > _ASKED

    @property
    def caution(self) -> str:
        """Why the result is to be used with care: of the change of volume, two thirds to all came back on phantoms."""
        return f"{self.volume_told} It may be larger than was found." if self.frees_volume else ""

    @property
    def volume_told(self) -> str:
        """How the change of volume was held, and why."""
        if self.asked is None:
            return f"Its weight was fixed beforehand, {self.weights.volume:g}/mm3."
        found = f"{100.0 * self.asked:.1f} % or more in a hundredth of the soft tissue"
        if not self.frees_volume:
            return f"The images ask for no more change of volume than noise does, {found}: volume was kept."
        held = f"only its gradient held ({self.weights.volume_gradient:g}/mm)"
        return f"The images ask for a change of volume, of {found}: it was allowed, and {held}."

    @property
    def caption(self) -> str:
        """The rules by which the weights were chosen."""
        return f"{self.rule}. {self.volume_told}"

    def rows(self) -> list[tuple[str, float, str, str | float]]:
        """Each weight: what it penalises, its value, its unit, and "used" or what it left out, % above the least."""
        stiff = f"strain of {_RIGID[self.at_interfaces]}"
        return [
            ("bending", self.weights.bending, "1/mm", "used"),
            ("change of volume in soft tissue", self.weights.volume, "1/mm3", "used"),
            ("gradient of that change", self.weights.volume_gradient, "1/mm", "used"),
            (stiff, self.weights.rigidity, "1/mm3", "used"),
            *(("bending", weight, "1/mm", 100.0 * (left - 1.0)) for weight, left in self.tried),
            *((stiff, weight, "1/mm3", 100.0 * (left - 1.0)) for weight, left in self.tried_in_skin),
        ]

    def as_dict(self) -> dict[str, object]:
        """Plain values for JSON."""
        asked, above = (None, None) if self.asked is None else (round(self.asked, 4), _ASKED)
        skin = [{"rigidity": weight, "left_out_over_best": round(left, 6)} for weight, left in self.tried_in_skin]
        return {
            "weights": asdict(self.weights),
            "rigidity_of": _RIGID[self.at_interfaces],
            "rule": self.rule,
            "tried": [{"bending": weight, "left_out_over_best": round(left, 6)} for weight, left in self.tried],
            "change_of_volume": {"rule": self.volume_told, "asked": asked, "allowed_above": above},
            **({"tried_in_skin": skin} if skin else {}),
            "borders": self.at_interfaces,
        }
