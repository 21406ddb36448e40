"""Files: paths refused early, errors of writing in one line, and models with the lights and cameras of their files."""

from rts.files.lit_models import load_lit
from rts.files.paths import output_file, output_folder, writing

__all__ = ["load_lit", "output_file", "output_folder", "writing"]
