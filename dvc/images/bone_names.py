"""Names of labels that tell a bone."""

import re

BONE = "bone"
"""Name of the bone in a label map that is made from its mask."""
_BONES = {
    "bone", "bones", "ankle", "calcaneus", "talus", "tibia", "fibula", "navicular", "cuboid", "cuneiform", "metatarsal",
    "femur", "trochanter", "patella", "pelvis", "sacrum", "coccyx", "ilium", "ischium", "pubis", "vertebra",
    "vertebrae", "hip", "rib", "sternum", "scapula", "clavicle", "humerus", "radius", "ulna", "tarsal", "phalanx",
    "phalanges", "sesamoid",
}  # fmt: skip
_SOFT = {
    "fat", "pad", "muscle", "skin", "tendon", "ligament", "fascia", "aponeurosis", "tissue", "cartilage", "bursa",
    "nerve", "vessel", "artery", "vein", "capsule", "retinaculum", "meniscus", "disc", "marrow",
}  # fmt: skip


def is_bones_name(name: str) -> bool:
    """Whether a label is named like a bone.

    >>> [is_bones_name(name) for name in ("Talus", "tibia_left", "metatarsals", "fat pad", "ankle ligaments")]
    [True, True, True, False, False]
    """
    words = set(re.split(r"[^a-z]+", name.lower()))
    words |= {word.removesuffix("s") for word in words}
    return bool(words & _BONES) and not words & _SOFT
