"""The operator screen: a client of the event stream. Data in, pixels out."""
