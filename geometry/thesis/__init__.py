"""The methods of the thesis, as it gives them: the peers that the default methods are measured against."""
