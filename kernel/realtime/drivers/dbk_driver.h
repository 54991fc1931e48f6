/* Interface of a robot driver in C. Both functions return at once: no lock, no allocation, no waiting. */
#ifndef DBK_DRIVER_H
#define DBK_DRIVER_H

#include "dbk_control_data.h"

typedef struct {
  void *self;
  /* 1 if a state arrived since the last call: the newest one */
  int (*read)(void *self, uint64_t now_us, dbk_joint_state *state);
  void (*write)(void *self, uint64_t now_us, const dbk_joint_command *command);
} dbk_driver;

#endif
