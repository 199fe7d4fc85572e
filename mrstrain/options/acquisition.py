"""Parameters of the acquisition that a person states because no header has them."""

from typing import ClassVar

from mrstrain.options.model import Options, Positive, Said


class AcquisitionOptions(Options):
    """How the images were acquired, and what is known of their noise and of the resolution of the measurement."""

    panel: ClassVar[str] = "Acquisition"

    manufacturer: Said = None
    """Maker of the scanner."""
    scanner: Said = None
    """Model of the scanner."""
    field_strength_t: Positive | None = None
    """Strength of the static field, T."""
    sequence_type: Said = None
    """Kind of sequence, such as 3D gradient echo, spoiled."""
    sequence_name: Said = None
    """Name of the sequence on the scanner."""
    repetition_time_ms: Positive | None = None
    """Repetition time TR, ms."""
    echo_time_ms: Positive | None = None
    """Echo time TE, ms."""
    flip_angle_deg: Positive | None = None
    """Flip angle, degrees."""
    acquisition_matrix: Said = None
    """Samples along frequency and phase encoding, such as 256 x 192; an image may be interpolated to more voxels."""
    snr: Positive | None = None
    """Signal-to-noise ratio, if it was not measured from the images."""
    noise_floor: Said = None
    """Noise floor of the strain, if it was not measured by the repeat scan."""
    spatial_resolution: Said = None
    """Spatial resolution of the strain on these images, and how it was measured."""
