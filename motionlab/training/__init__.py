"""From recordings to the weights that ship: ``motionlab train``. Nothing of the library imports this room.

courses        what is trained for days: goes on from what ships, judges itself, keeps its state; and the command
recipes        what is trained in minutes, from which data, and the recipe that is written beside it
training_loop  the loop of all of them: resumable to the bit
completer_training, denoiser_training, chain_training
               a network each
model_card     the table of the models that ship
"""
