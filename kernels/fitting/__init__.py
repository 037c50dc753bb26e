"""Losses and their gradients, optimiser steps, and what else a fit launches."""
