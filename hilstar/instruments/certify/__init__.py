"""How sure a bench is: readings of it, the budget of their uncertainties, the certificate, and
the check in a minute.
"""
