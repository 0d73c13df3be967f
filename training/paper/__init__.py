"""The method of the paper: state classifier, bend regression, reconstruction, post-processor.

`method.PaperMethod` joins the `stages`; each has `fit` and `apply`.
"""
