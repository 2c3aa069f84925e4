"""Training of the detector's networks, and what else is fitted: `python -m toftrack.training`.

Nothing else imports it.
"""
