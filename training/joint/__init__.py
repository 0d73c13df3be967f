"""The joint method: bend and touches as the MAP estimate of a learned sensor model.

Learned by `training`: features, touch response, bend curves, priors, proposal network. A frame
passes `method`, `proposal_model`, `fit`, and `touch_map`; `angles` tells that of an untouched one.
"""
