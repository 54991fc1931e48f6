/* First process of the virtual machine; see first_process.h. */
#define _GNU_SOURCE
#include "first_process.h"

#include <stdio.h>
#include <sys/mount.h>
#include <sys/reboot.h>
#include <sys/stat.h>
#include <termios.h>
#include <unistd.h>

static int is_first(void) { return getpid() == 1; }

void first_process_begin(void) {
  if (!is_first()) { return; }
  mkdir("/sys", 0555);
  if (mount("sysfs", "/sys", "sysfs", 0, NULL)) { perror("mount /sys"); }
}

void first_process_end(void) {
  if (!is_first()) { return; }
  fflush(stdout);
  tcdrain(STDOUT_FILENO);
  reboot(RB_POWER_OFF);
}
