"""The regularisation weights of a Gauss-Newton registration, and why they were chosen."""

from dataclasses import asdict, dataclass

from dvc.registration.engine import Regularisation
from dvc.registration.gauss_newton.level import Weights

_RIGID = {False: "bone", True: "skin"}  # whose strain the weight "rigidity" is of, by `at_interfaces`
_ASKED = 0.05  # change of volume that a hundredth of the soft tissue exceeds: loads reach .048, swelling has .054


@dataclass(frozen=True, slots=True)
class Choice(Regularisation):
    """The regularisation weights that were used, and why.

    Each weight that was tried is paired with the mean square residual in the voxels left out, relative to the lowest.
    `asked` is the volume change that 1 % of the soft tissue exceeds if only its gradient is penalised; None if the
    weight of the volume change was fixed beforehand. `in_bone` is the displacement (rms, mm) and the 95th percentile of
    the maximum shear strain in the bone, from the smooth displacement that preceded the one with a rigid bone.
    `coarse` says that voxels are too large to tell a change of volume.
    """

    weights: Weights
    rule: str
    tried: tuple[tuple[float, float], ...] = ()
    tried_in_skin: tuple[tuple[float, float], ...] = ()
    at_interfaces: bool = False
    asked: float | None = None
    coarse: bool = False
    in_bone: tuple[float, float] | None = None

    @property
    def frees_volume(self) -> bool:
        """Whether the images indicate a volume change, so that only its gradient was penalised."""
        return self.asked is not None and self.asked > _ASKED

    @property
    def caution(self) -> str:
        """Why the result is to be used with care: of the change of volume, two thirds to all came back on phantoms."""
        return f"{self.volume_told} The true change may be larger." if self.frees_volume else ""

    @property
    def volume_told(self) -> str:
        """How the volume change was penalised, and why."""
        if self.coarse:
            return "Incompressibility was enforced: in voxels this large, a volume change cannot be told from noise."
        if self.asked is None:
            return f"The weight of the volume change was fixed at {self.weights.volume:g}/mm3."
        found, limit = f"at least {100.0 * self.asked:.1f} % in 1 % of the soft tissue", f"{100.0 * _ASKED:.0f} %"
        if not self.frees_volume:
            return (
                f"Incompressibility was enforced. In a test without it, volumes changed by {found}; up to {limit} may "
                "be noise."
            )
        relaxed = f"Incompressibility was relaxed: the images indicate volume changes of {found} (limit: {limit})."
        return f"{relaxed} Only the gradient of the volume change was penalised ({self.weights.volume_gradient:g}/mm)."

    @property
    def _rigid(self) -> str | None:
        """What resists strain; None where the bone cannot be strained, and there is no skin."""
        return None if self.at_interfaces and self.weights.rigidity == 0.0 else _RIGID[self.at_interfaces]

    @property
    def caption(self) -> str:
        """The rules by which the weights were chosen."""
        return f"{self.rule[:1].upper()}{self.rule[1:]}. {self.volume_told}"

    def rows(self) -> list[tuple[str, float, str, str | float]]:
        """Each weight: what it penalises, its value, its unit, and "used" or what it left out, % above the least."""
        stiff = f"strain of {self._rigid}"
        return [
            ("bending", self.weights.bending, "1/mm", "used"),
            ("volume change in soft tissue", self.weights.volume, "1/mm3", "used"),
            ("gradient of the volume change", self.weights.volume_gradient, "1/mm", "used"),
            *([(stiff, self.weights.rigidity, "1/mm3", "used")] if self._rigid else []),
            *(("bending", weight, "1/mm", 100.0 * (left - 1.0)) for weight, left in self.tried),
            *((stiff, weight, "1/mm3", 100.0 * (left - 1.0)) for weight, left in self.tried_in_skin),
        ]

    def as_dict(self) -> dict[str, object]:
        """Plain values for JSON."""
        asked, above = (None, None) if self.asked is None else (round(self.asked, 4), _ASKED)
        skin = [{"rigidity": weight, "left_out_over_best": round(left, 6)} for weight, left in self.tried_in_skin]
        return {
            "weights": asdict(self.weights),
            "rigidity_of": self._rigid,
            "rule": self.rule,
            "tried": [{"bending": weight, "left_out_over_best": round(left, 6)} for weight, left in self.tried],
            "change_of_volume": {"rule": self.volume_told, "asked": asked, "allowed_above": above},
            **({"tried_in_skin": skin} if skin else {}),
            "borders": self.at_interfaces,
        }
