"""SGIM-SAHT: a learner of skills that decides what to practise, how, and with whom, by its progress over what it costs.

See docs/saht.md. Knows worlds (`envs.worlds`), SGIM's selection and regions; nothing of the three levels.
"""
