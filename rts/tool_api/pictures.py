"""Pictures: their formats, the sRGB curve, exposure, and fewer pixels."""

from rts.files.images import PICTURES
from rts.files.srgb import decode_srgb, encode_srgb
from rts.fitting.schedule import box_filtered
from rts.shading.tone_mapping import check_exposure

__all__ = ["PICTURES", "box_filtered", "check_exposure", "decode_srgb", "encode_srgb"]
