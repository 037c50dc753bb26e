"""Gradients, optimiser steps and what a fit needs around them."""
