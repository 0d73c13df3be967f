"""Structure and the direct solver of sparse symmetric systems, electrical and mechanical.

`sparse_structure` says where entries are and in which blocks unknowns are eliminated;
`multifrontal` eliminates them.
"""
