/* What a signal does at once. A handler in Python waits until the interpreter is back from what it has called, which may
   hang; so may a process whose launcher was killed. */

#define _GNU_SOURCE
#include <errno.h>
#include <poll.h>
#include <pthread.h>
#include <signal.h>
#include <stdint.h>
#include <time.h>
#include <unistd.h>
#ifdef __linux__
#include <sys/prctl.h>
#include <sys/syscall.h>
#endif

enum { SIGNALS = 65 };
static void (*then[SIGNALS])(int); /* handlers of Python */
static volatile sig_atomic_t asked; /* a signal has come that asks the run to end */
static struct timespec since;       /* when it came */
static double same_request;         /* s after it in which another one is no second request */
static pid_t parent;

/* The first request is Python's; a second one ends the process as if nobody handled it. SIGXCPU comes every second. */
static void on_stop(int number) {
  int error = errno;
  struct timespec now;
  clock_gettime(CLOCK_MONOTONIC, &now);
  double passed = (double)(now.tv_sec - since.tv_sec) + 1e-9 * (double)(now.tv_nsec - since.tv_nsec);
  if (!asked) {
    since = now;
    asked = 1;
  } else if (passed > same_request && number != SIGXCPU) {
    signal(number, SIG_DFL);
    raise(number); /* once this handler is left */
  }
  then[number](number);
  errno = error;
}

/* Come before the handler of a signal that Python has installed, and wait for a first request; 0 where that is done. */
int watch_signal(int number, double seconds) {
  struct sigaction action;
  if (number < 1 || number >= SIGNALS || sigaction(number, NULL, &action)) return -1;
  same_request = seconds;
  asked = 0;
  if (action.sa_handler == on_stop) return 0;
  if (action.sa_handler == SIG_DFL || action.sa_handler == SIG_IGN) return -1;
  then[number] = action.sa_handler;
  action.sa_handler = on_stop;
  return sigaction(number, &action, NULL);
}

/* The kernel tells of the end of a thread of the parent as well. */
static void on_end_of_parent(int number) {
  (void)number;
  if (getppid() != parent) kill(getpid(), SIGKILL);
}

/* End this process when its parent, of this number, ends; `number`: of a signal that nobody else uses. */
void end_with_parent(int process, int number) {
#ifdef __linux__
  struct sigaction action = {.sa_handler = on_end_of_parent, .sa_flags = SA_RESTART};
  parent = (pid_t)process;
  sigemptyset(&action.sa_mask);
  if (sigaction(number, &action, NULL) || prctl(PR_SET_PDEATHSIG, number)) return;
  on_end_of_parent(number); /* it may have ended before */
#else
  (void)process, (void)number;
#endif
}

#if defined(__linux__) && defined(SYS_pidfd_open)
static void *wait_for_end(void *descriptor) {
  struct pollfd ended = {.fd = (int)(intptr_t)descriptor, .events = POLLIN};
  while (poll(&ended, 1, -1) < 0 && errno == EINTR)
    ;
  if (ended.revents & POLLIN) kill(getpid(), SIGKILL);
  return NULL;
}
#endif

/* End this process when another one ends: a thread waits for that, which gets no signals. */
void end_with_process(int process) {
#if defined(__linux__) && defined(SYS_pidfd_open)
  int descriptor = (int)syscall(SYS_pidfd_open, process, 0);
  sigset_t all, before;
  pthread_t thread;
  if (descriptor < 0) return;
  sigfillset(&all);
  pthread_sigmask(SIG_BLOCK, &all, &before);
  if (!pthread_create(&thread, NULL, wait_for_end, (void *)(intptr_t)descriptor)) pthread_detach(thread);
  pthread_sigmask(SIG_SETMASK, &before, NULL);
#else
  (void)process;
#endif
}
