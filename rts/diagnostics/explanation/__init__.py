"""Why derivatives disagree with the truth, or vanish: experiments on a scene, and what they tell."""
