"""Rendering: settings → scene → samples → splats → shade → image, of one view or of several."""
