"""Imported after all else by the process that others are forked from, which SIGTERM then ends without a stack."""

from groundwalk.store.signals import keep_handlers

keep_handlers()
