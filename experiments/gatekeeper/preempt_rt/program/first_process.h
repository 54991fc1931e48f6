/* The duties of the first process of a machine without an operating system around it. */
#ifndef FIRST_PROCESS_H
#define FIRST_PROCESS_H

/* mounts /sys, if this is the first process */
void first_process_begin(void);

/* switches the machine off, if this is the first process */
void first_process_end(void);

#endif
