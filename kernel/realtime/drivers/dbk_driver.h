/* Interface of a robot driver in C. `read`, `write` and `clock` return at once: no lock, no allocation, no waiting. */
#ifndef DBK_DRIVER_H
#define DBK_DRIVER_H

#include "dbk_control_data.h"

typedef struct {
  void *self;
  /* 1 if a state arrived since the last call: the newest one */
  int (*read)(void *self, uint64_t now_us, dbk_joint_state *state);
  void (*write)(void *self, uint64_t now_us, const dbk_joint_command *command);
  /* Waits until a state has arrived, at most until `until_us` of CLOCK_MONOTONIC. NULL: ticks are paced by the clock. */
  void (*wait)(void *self, uint64_t until_us);
  /* The robot's time at `now_us` of CLOCK_MONOTONIC; it never decreases. NULL: the stamps of states are CLOCK_MONOTONIC. */
  uint64_t (*clock)(void *self, uint64_t now_us);
} dbk_driver;

#endif
