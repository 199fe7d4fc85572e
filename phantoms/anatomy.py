"""A heel defined in space: which tissue lies at a point, and its proton-density signal there.

Right foot, LPS mm: x to medial, toes toward -y, sole toward -z. Shapes are closed forms, and textures are hashes of the
seed and of lattice coordinates, so that a point has the same signal at any voxel size.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dvc.arrays import FloatArray, IntArray
from dvc.compiled import njit
from dvc.errors import InputError
from dvc.threads import in_parts
from phantoms.bodies import EllipsoidUnion, distance
from phantoms.compiled import at_point

TISSUES: Mapping[int, str] = {1: "bone", 2: "fat", 3: "muscle", 4: "skin", 5: "tendon", 6: "ankle"}
"""Label numbers and names. "bone" is the calcaneus; "ankle" are the other bones, which move with it."""

FAT_SIGNAL = 675.0
"""Mean signal of fat and its septa, arbitrary units; the SNR refers to it."""

_BONE, _FAT, _MUSCLE, _SKIN, _TENDON, _ANKLE = 1, 2, 3, 4, 5, 6
_LOBULE_SIGNAL, _MARROW_SIGNAL, _MUSCLE_SIGNAL, _SKIN_SIGNAL = 900.0, 760.0, 400.0, 300.0
_TENDON_SIGNAL, _CORTEX_SIGNAL = 110.0, 60.0
_EDGE_MM = 0.6  # half width of the blend at an interface, so that samples every 0.4 mm resolve it

# Centre (mm), semi-axes (mm), turns about x, y, z (degrees).
_CALCANEUS = (
    ((0.0, 20.0, -4.0), (14.5, 14.5, 17.5), (18.0, 0.0, 0.0)),  # tuberosity
    ((3.5, 19.0, -15.0), (9.5, 10.5, 8.8), (0.0, 0.0, 0.0)),  # medial process, the lowest point
    ((-7.0, 17.0, -13.0), (6.5, 8.0, 8.0), (0.0, 0.0, 0.0)),  # lateral process
    ((-1.0, -1.0, 0.5), (12.5, 25.0, 11.5), (-16.0, 0.0, 0.0)),  # body
    ((-3.0, -22.0, 4.5), (11.0, 10.5, 9.8), (-10.0, 0.0, 8.0)),  # anterior process
    ((13.0, -9.0, 9.5), (9.0, 9.5, 5.0), (0.0, -12.0, 0.0)),  # sustentaculum tali
    ((-2.0, -2.0, 9.5), (12.0, 10.5, 8.5), (-28.0, 0.0, 0.0)),  # posterior facet
)
_ANKLE_BONES = (
    ((0.0, -9.0, 32.5), (15.5, 18.0, 9.5), (-8.0, 0.0, 0.0)),  # talus, dome
    ((6.0, -33.0, 22.5), (11.5, 13.5, 10.0), (22.0, 0.0, 0.0)),  # talus, head
    ((1.0, -9.0, 72.0), (20.0, 19.0, 28.0), (0.0, 0.0, 0.0)),  # tibia
    ((18.0, -9.0, 43.0), (5.5, 9.0, 13.0), (0.0, 6.0, 0.0)),  # medial malleolus
    ((-19.5, 1.0, 56.0), (6.0, 8.0, 36.0), (0.0, 4.0, 0.0)),  # fibula
    ((-6.0, -46.0, 1.0), (12.0, 12.5, 10.5), (-8.0, 0.0, 0.0)),  # cuboid
    ((10.0, -55.0, 17.0), (14.0, 7.5, 12.0), (15.0, 0.0, 0.0)),  # navicular
)
_MUSCLES = (
    ((4.0, -36.0, -22.0), (15.0, 42.0, 8.5), (-7.0, 0.0, 0.0)),  # flexor digitorum brevis
    ((20.0, -26.0, -9.0), (7.0, 34.0, 11.0), (-14.0, 10.0, 0.0)),  # abductor hallucis
    ((-19.0, -26.0, -19.0), (7.5, 38.0, 7.5), (-4.0, 0.0, 0.0)),  # abductor digiti minimi
    ((4.0, -32.0, -9.0), (14.0, 28.0, 8.5), (-14.0, 0.0, 0.0)),  # quadratus plantae
    ((0.0, -9.0, 40.0), (21.5, 30.0, 38.0), (0.0, 0.0, 0.0)),  # deep compartments around the ankle
    ((0.5, 13.0, 43.0), (20.5, 13.0, 31.0), (-4.0, 0.0, 0.0)),  # flexor hallucis longus, soleus
    ((-17.0, -30.0, 17.0), (8.5, 19.0, 8.0), (26.0, -14.0, 0.0)),  # extensor digitorum brevis
    ((0.0, -44.0, 16.0), (24.0, 26.0, 19.0), (20.0, 0.0, 0.0)),  # extensors, dorsum
)
_OUTLINE = (
    ((0.0, 10.5, -13.0), (28.0, 34.0, 29.0), (0.0, 0.0, 0.0)),  # heel
    ((0.0, 1.0, 62.0), (25.0, 34.5, 78.0), (0.0, 0.0, 0.0)),  # ankle and leg
    ((1.0, -46.0, -2.5), (29.0, 74.0, 30.5), (5.0, 0.0, 0.0)),  # midfoot
)
_OF_SOLE = (True, False, True)  # which parts of the outline move with the pad's thickness
_PAD_MM = 18.0
_SHARP = {"bone": 5.0, "ankle": 8.0, "muscle": 8.0, "outline": 3.5, "flesh": 3.5}
_RANGES = dict(size=(0.7, 1.3), pad_mm=(10.0, 26.0), skin_mm=(1.0, 4.0), cortex_mm=(0.5, 3.0), lobule_mm=(2.0, 12.0))
_Triple = tuple[float, float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Heel:
    """A right heel drawn from a seed: shapes differ by about 1 mm between seeds, textures completely.

    Parameters
    ----------
    seed : int
        0 or more.
    size : float
        Scale factor of all shapes; at 1 the calcaneus is 67 mm long.
    pad_mm : float
        Approximate thickness of the tissue below the calcaneus, skin included, mm at size 1.
    skin_mm, cortex_mm : float
        Thickness of the skin and of the cortical rim of bones, mm.
    lobule_mm : float
        Mean width of fat lobules, which are divided by fibrous septa, mm.

    Raises
    ------
    InputError
        If the seed is negative or a number is out of its range: size 0.7 to 1.3, pad 10 to 26 mm, skin 1 to 4 mm,
        cortex 0.5 to 3 mm, lobules 2 to 12 mm.

    Examples
    --------
    >>> heel = Heel(seed=1)
    >>> tissue = heel.tissue_at(np.array([[0.0, 10.0, 0.0], [0.0, 20.0, -33.0], [0.0, 20.0, -60.0]]))
    >>> [TISSUES.get(int(t), "air") for t in tissue]
    ['bone', 'fat', 'air']
    """

    seed: int = 1
    size: float = 1.0
    pad_mm: float = 18.0
    skin_mm: float = 2.0
    cortex_mm: float = 1.2
    lobule_mm: float = 6.0
    bone: EllipsoidUnion = field(init=False)
    ankle: EllipsoidUnion = field(init=False)
    muscle: EllipsoidUnion = field(init=False)
    outline: EllipsoidUnion = field(init=False)
    flesh: EllipsoidUnion = field(init=False)

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise InputError(f"The seed of a heel must be 0 or more; got {self.seed}.")
        for name, (low, high) in _RANGES.items():
            if not low <= getattr(self, name) <= high:
                raise InputError(f"{name} must be between {low:g} and {high:g}; got {getattr(self, name)}.")
        random = np.random.default_rng([self.seed, 1])

        def vary(shapes: tuple[tuple[_Triple, _Triple, _Triple], ...], jitter: float) -> list[Any]:
            drawn = ((centre, axes, turns, random.uniform(-1.0, 1.0, (2, 3))) for centre, axes, turns in shapes)
            return [(np.add(c, jitter * r[0]), np.multiply(a, 1.0 + 0.02 * r[1]), turns) for c, a, turns, r in drawn]

        bones = {"bone": vary(_CALCANEUS, 0.6), "ankle": vary(_ANKLE_BONES, 0.6)}
        varied = bones | {"muscle": vary(_MUSCLES, 0.6), "outline": vary(_OUTLINE, 0.4)}
        # Only the sole moves with the pad's thickness: half in the centre, half in the semi-axis leaves the top alone.
        lower = np.outer(_OF_SOLE, [0.0, 0.0, 0.5 * (self.pad_mm - _PAD_MM)])
        outline = zip(varied["outline"], lower, strict=True)
        varied["outline"] = [(centre - down, axes + down, turns) for (centre, axes, turns), down in outline]
        # The skin's inner surface: the same shapes with semi-axes shorter by its thickness, which is that exactly at
        # their ends and a little less between.
        skin = self.skin_mm / self.size
        varied["flesh"] = [(centre, axes - skin, turns) for centre, axes, turns in varied["outline"]]
        for name, parts in varied.items():
            scaled = [((self.size * c).tolist(), (self.size * a).tolist(), turns) for c, a, turns in parts]
            object.__setattr__(self, name, EllipsoidUnion.of(scaled, _SHARP[name]))

    @property
    def skeleton(self) -> EllipsoidUnion:
        """All bones as one body, which holds each of them."""
        a, b = self.bone, self.ankle
        centres, forms = np.concatenate([a.centres_mm, b.centres_mm]), np.concatenate([a.forms, b.forms])
        return EllipsoidUnion(centres, forms, min(a.sharpness, b.sharpness))

    def _parameters(self) -> tuple[FloatArray, ...]:
        bodies = (self.bone, self.ankle, self.muscle, self.outline, self.flesh)
        numbers = np.array([self.size, self.cortex_mm, self.lobule_mm, float(self.seed)])
        sharpness = np.array([body.sharpness for body in bodies])
        return (numbers, sharpness, *(a for body in bodies for a in (body.centres_mm, body.forms)))

    def tissue_at(self, points_mm: FloatArray) -> IntArray:
        """Labels (n,) of TISSUES at points (n, 3) LPS mm; 0 is air."""
        points = np.ascontiguousarray(points_mm, dtype=np.float64)
        out = np.empty(len(points), dtype=np.int64)
        in_parts(_tissues, len(points), points, self._parameters(), out)
        return out

    def intensity_at(self, points_mm: FloatArray) -> FloatArray:
        """Noise-free signal (n,) at points (n, 3) LPS mm; air is 0."""
        points = np.ascontiguousarray(points_mm, dtype=np.float64)
        return self._signals(points, np.zeros((1, 3, 3)), 1)[:, 0]

    def octant_intensity(self, points_mm: FloatArray, axes_mm: FloatArray) -> FloatArray:
        """Noise-free signal (n, 2, 2, 2) at a quarter of each edge before and behind centres (n, 3) of voxels, LPS mm.

        Columns of ``axes_mm`` are the voxel's edges, LPS mm: (3, 3) for all, or (n, 3, 3), one set for each voxel, as
        where the voxels of a loaded image are carried back into the unloaded heel.
        """
        points = np.ascontiguousarray(points_mm, dtype=np.float64)
        axes = np.ascontiguousarray(axes_mm, dtype=np.float64).reshape(-1, 3, 3)
        return self._signals(points, axes, 8).reshape(-1, 2, 2, 2)

    def _signals(self, points: FloatArray, axes: FloatArray, samples: int) -> FloatArray:
        out = np.empty((len(points), samples))
        in_parts(_signals, len(points), points, axes, self._parameters(), out)
        return out


@at_point
def _hash(i, j, k, salt):  # type: ignore[no-untyped-def]
    """Draw a number in [0, 1) from lattice coordinates, by integer mixing (splitmix64's finaliser)."""
    h = np.uint64(i * 73856093) ^ np.uint64(j * 19349663) ^ np.uint64(k * 83492791)
    h ^= np.uint64(salt) * np.uint64(0x9E3779B97F4A7C15)
    h = (h ^ (h >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    h = (h ^ (h >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    h ^= h >> np.uint64(31)
    return np.float64(h >> np.uint64(11)) / 9007199254740992.0


@at_point
def _noise(x, y, z, salt):  # type: ignore[no-untyped-def]
    """Smooth lattice noise in [-1, 1]: hashed values at integer points, blended by a cubic step."""
    i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
    a, b, c = x - i, y - j, z - k
    a, b, c = a * a * (3 - 2 * a), b * b * (3 - 2 * b), c * c * (3 - 2 * c)
    total = 0.0
    for m in range(8):
        di, dj, dk = m & 1, (m >> 1) & 1, m >> 2
        weight = (a if di else 1 - a) * (b if dj else 1 - b) * (c if dk else 1 - c)
        total += weight * _hash(i + di, j + dj, k + dk, salt)
    return 2.0 * total - 1.0


@at_point
def _lobule(x, y, z, salt):  # type: ignore[no-untyped-def]
    """Distance to the border of a Voronoi cell of a jittered unit lattice, and a number of the cell's own."""
    i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
    first, second = 1e9, 1e9
    ax, ay, az, bx, by, bz, own = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for di in range(-1, 2):
        for dj in range(-1, 2):
            for dk in range(-1, 2):
                r = _hash(i + di, j + dj, k + dk, salt)
                # three offsets from one hash: its leading, middle and trailing digits
                sx = i + di + 0.15 + 0.7 * r
                r = r * 4096.0
                sy = j + dj + 0.15 + 0.7 * (r - np.floor(r))
                r = (r - np.floor(r)) * 4096.0
                sz = k + dk + 0.15 + 0.7 * (r - np.floor(r))
                d = (x - sx) ** 2 + (y - sy) ** 2 + (z - sz) ** 2
                if d < first:
                    second, bx, by, bz = first, ax, ay, az
                    first, ax, ay, az, own = d, sx, sy, sz, r - np.floor(r)
                elif d < second:
                    second, bx, by, bz = d, sx, sy, sz
    apart = np.sqrt((ax - bx) ** 2 + (ay - by) ** 2 + (az - bz) ** 2)
    return (second - first) / (2.0 * apart), own


@at_point
def _depths(x, y, z, heel):  # type: ignore[no-untyped-def]
    """Depth of a point below the surface (mm) of the foot, its flesh, bone, ankle, tendon, muscle; negative outside."""
    numbers, k, bone_c, bone_f, ankle_c, ankle_f, muscle_c, muscle_f, out_c, out_f, flesh_c, flesh_f = heel
    foot = -distance(x, y, z, out_c, out_f, k[3])
    if foot <= -_EDGE_MM:
        return foot, -1e3, -1e3, -1e3, -1e3, -1e3
    flesh = -distance(x, y, z, flesh_c, flesh_f, k[4])
    bone = -distance(x, y, z, bone_c, bone_f, k[0])
    ankle = -distance(x, y, z, ankle_c, ankle_f, k[1])
    muscle = -distance(x, y, z, muscle_c, muscle_f, k[2])
    size = numbers[0]
    x, y, z = x / size, y / size, z / size
    # Achilles tendon: a flat band down to the back of the tuberosity
    behind = 31.5 + 0.05 * max(z, 0.0)
    wide = 6.0 + 4.0 * np.exp(-(((z - 2.0) / 9.0) ** 2))
    achilles = min(2.6 * (1.0 - np.sqrt((x / wide) ** 2 + ((y - behind) / 2.6) ** 2)), z + 4.0)
    # plantar aponeurosis: a sheet under the short flexor, from the medial process forward
    below = -30.2 + 0.13 * (y + 36.0) + 0.006 * (x - 4.0) ** 2 - z
    sheet = min(below, 1.8 - below, 18.0 - y, 11.0 - abs(x - 4.0))
    return foot, flesh, bone, ankle, size * max(achilles, sheet), muscle


@at_point
def _tissue(x, y, z, heel):  # type: ignore[no-untyped-def]
    foot, flesh, bone, ankle, tendon, muscle = _depths(x, y, z, heel)
    if foot <= 0.0:
        return 0
    if flesh <= 0.0:
        return _SKIN
    if bone >= 0.0:
        return _BONE
    if ankle >= 0.0:
        return _ANKLE
    if tendon > 0.0:
        return _TENDON
    if muscle >= 0.0:
        return _MUSCLE
    return _FAT


@at_point
def _share(depth):  # type: ignore[no-untyped-def]
    """Share of a body at a depth below its surface: 0 outside, 1 inside, and a smooth edge between."""
    t = min(1.0, max(0.0, 0.5 + 0.5 * depth / _EDGE_MM))
    return t * t * (3.0 - 2.0 * t)


@at_point
def _signal(x, y, z, depths, heel):  # type: ignore[no-untyped-def]
    """Signals of the tissues at a point by their shares, from the outermost body to the innermost."""
    foot, flesh, bone, ankle, tendon, muscle = depths
    numbers = heel[0]
    salt = 16 * int(numbers[3])
    left = _share(foot)
    if left == 0.0:
        return 0.0
    fine = _noise(x / 1.7, y / 1.7, z / 1.7, salt)
    total = 0.0
    share = left * _share(-flesh)
    if share > 0.0:
        patch = _noise(x / 4.5, y / 4.5, z / 4.5, salt + 11)  # pores, creases and vessels
        total += share * _SKIN_SIGNAL * (1.0 + 0.25 * fine + 0.4 * patch)
        left -= share
    for depth in (bone, ankle):
        share = left * _share(depth)
        if share > 0.0:
            marrow = _share(depth - numbers[1])
            total += share * (1.0 - marrow) * _CORTEX_SIGNAL * (1.0 + 0.2 * fine)
            total += share * marrow * _marrow(x, y, z, depth - numbers[1], fine, salt)
            left -= share
    share = left * _share(tendon)
    if share > 0.0:
        total += share * _TENDON_SIGNAL * (1.0 + 0.35 * _noise(x / 1.5, y / 5.0, z / 5.0, salt + 3))
        left -= share
    share = left * _share(muscle)
    if share > 0.0:
        fibre = _noise(x / 1.9, y / 9.0, z / 1.9, salt + 4)
        streak = max(0.0, _noise(x / 3.3, y / 14.0, z / 3.3, salt + 5) - 0.45)
        total += share * _MUSCLE_SIGNAL * (1.0 + 0.22 * fibre + 0.14 * fine + 1.6 * streak)
        left -= share
    if left > 0.0:
        total += left * _fat(x, y, z, numbers[2], fine, salt)
    return total


@at_point
def _marrow(x, y, z, depth, fine, salt):  # type: ignore[no-untyped-def]
    coarse = _noise(x / 4.5, y / 4.5, z / 4.5, salt + 1)
    # trabeculae: dark sheets where a lattice noise passes through zero
    beam = np.exp(-((_noise(x / 2.8, y / 2.8, z / 2.8, salt + 2) / 0.35) ** 2))
    rise = 1.0 - 0.35 * np.exp(-max(depth, 0.0) / 1.5)
    return _MARROW_SIGNAL * rise * (1.0 + 0.12 * coarse + 0.1 * fine - 0.22 * beam)


@at_point
def _fat(x, y, z, wide, fine, salt):  # type: ignore[no-untyped-def]
    """Lobules, taller than wide, between fibrous septa of varying strength; fainter ones inside each."""
    bent = 0.15 * wide * _noise(x / 8.0, y / 8.0, z / 8.0, salt + 6)
    wavy = 0.08 * wide * _noise(x / 2.7, y / 2.7, z / 2.7, salt + 8)
    u, v, w = (x + bent + wavy) / wide, (y - bent + wavy) / wide, (z + wavy) / (1.5 * wide)
    border, own = _lobule(u, v, w, salt + 7)
    strength = 0.5 + 0.26 * _noise(x / 5.0, y / 5.0, z / 5.0, salt + 9)
    wall = np.exp(-((border * wide / 0.5) ** 2))
    border, part = _lobule(2.1 * u, 2.1 * v, 2.1 * w, salt + 10)
    thin = np.exp(-((border * wide / 0.9) ** 2))
    # each lobule has a level of its own, which ends at its wall
    level = 1.0 + 0.12 * (own - 0.5) * (1.0 - wall) + 0.1 * (part - 0.5) * (1.0 - thin) + 0.08 * fine
    return _LOBULE_SIGNAL * level * (1.0 - max(strength * wall, 0.24 * thin))


@njit(nogil=True, cache=True)
def _tissues(start, stop, points, heel, out):  # type: ignore[no-untyped-def]
    for n in range(start, stop):
        out[n] = _tissue(points[n, 0], points[n, 1], points[n, 2], heel)


@at_point
def _within_one_tissue(depths, reach):  # type: ignore[no-untyped-def]
    """Whether no border lies within reach, mm; in bone, whose signal changes with depth, never."""
    foot, flesh, bone, ankle, tendon, muscle = depths
    soft = bone < -reach and ankle < -reach
    return soft and abs(foot) > reach and abs(flesh) > reach and abs(tendon) > reach and abs(muscle) > reach


@njit(nogil=True, cache=True)
def _signals(start, stop, points, axes, heel, out):  # type: ignore[no-untyped-def]
    for n in range(start, stop):
        a = axes[n] if axes.shape[0] > 1 else axes[0]
        centre = _depths(points[n, 0], points[n, 1], points[n, 2], heel)
        # Distances are of first order, so the corners are given twice their distance.
        reach = _EDGE_MM + 0.5 * np.sqrt((a * a).sum())
        alike = _within_one_tissue(centre, reach)
        for m in range(out.shape[1]):
            s, t, w = 0.25 if m & 4 else -0.25, 0.25 if m & 2 else -0.25, 0.25 if m & 1 else -0.25
            x = points[n, 0] + s * a[0, 0] + t * a[0, 1] + w * a[0, 2]
            y = points[n, 1] + s * a[1, 0] + t * a[1, 1] + w * a[1, 2]
            z = points[n, 2] + s * a[2, 0] + t * a[2, 1] + w * a[2, 2]
            out[n, m] = _signal(x, y, z, centre if alike else _depths(x, y, z, heel), heel)
