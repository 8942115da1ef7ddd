"""Adam steps on the rows of the anchors in view, and the mean of the parameters over the latest steps."""
