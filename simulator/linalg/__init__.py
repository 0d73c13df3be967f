"""Assembly and the direct solver of sparse symmetric systems, electrical and mechanical.

`elimination_order` says in which blocks unknowns are eliminated, `multifrontal` eliminates them.
"""
