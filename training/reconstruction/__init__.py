"""Images of the conductivity change from a linear model of the sensor, without training.

`reconstructor.Reconstructor` joins the parts: the pixels of an outline, the Jacobian of a design,
methods with their regularisation, and figures of merit of the images.
"""
