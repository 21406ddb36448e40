"""Parameters fitted to images: `fit`, its methods, and residuals of images."""
