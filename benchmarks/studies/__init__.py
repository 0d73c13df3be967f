"""Single measurements that pages quote; run from a checkout, not part of the wheel."""
