"""The joint method: bend and touches as the MAP estimate of a learned sensor model.

Learned by `training`: features, touch response, bend curves, priors, networks. A frame passes
`method`, `networks` (proposals), `model_selection`, `objective`; `specimen_model` estimates the
angle of an untouched one, and `adaptation` learns from known frames of a sensor.
"""
