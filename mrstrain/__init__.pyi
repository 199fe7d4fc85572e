from .comparison.compare import compare
from .comparison.drive import drive
from .comparison.level import level
from .measurement.draw_strokes import draw_strokes
from .measurement.label import label
from .measurement.register import register
from .measurement.strain import strain
from .models.converge import converge
from .models.fit import fit
from .models.mesh import mesh
from .models.simulate import simulate
from .studies.check import check
from .studies.cohort import cohort
from .studies.init import init
from .studies.run import run
from .truth.accuracy import accuracy, accuracy_cases
from .truth.phantom import phantom
from .truth.twin import twin

__version__: str
__all__ = [
    "accuracy", "accuracy_cases", "check", "cohort", "compare", "converge", "draw_strokes", "drive", "fit", "init",
    "label", "level", "mesh", "phantom", "register", "run", "simulate", "strain", "twin",
]  # fmt: skip
