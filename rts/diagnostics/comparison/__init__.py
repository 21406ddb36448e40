"""Speed and accuracy of settings, measured on anyone's scene; what `compare` and `tune` are made of."""
