"""Make the head asset once from MakeHuman data: ``python -m services.driver.build_head``."""
