"""Fitting a field: gradients, optimiser steps, visual hulls."""
