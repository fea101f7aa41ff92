/* Loaded before the C library (LD_PRELOAD): one operation of a process on files below a folder fails, or all from one on. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/uio.h>
#include <unistd.h>

static char prefix[PATH_MAX];
static atomic_long count;
static long first, last;
static int number;

/* Let operations `from` to `to`, counted from 1, on files below `folder` fail with this error; 0 lets none fail.
   An error below 0 is a signal that the process gets then. */
void fault_arm(const char *folder, long from, long to, int error) {
  strncpy(prefix, folder, sizeof prefix - 1);
  count = 0;
  first = from;
  last = to;
  number = error;
}

long fault_count(void) { return count; }

static int path_fails(const char *path) {
  char whole[2 * PATH_MAX];
  if (!prefix[0]) return 0;
  if (path[0] != '/') {
    if (!getcwd(whole, PATH_MAX)) return 0;
    strcat(whole, "/");
    path = strncat(whole, path, PATH_MAX - 2);
  }
  if (strncmp(path, prefix, strlen(prefix)) != 0) return 0;
  long at = ++count;
  if (at < first || at > last) return 0;
  if (number < 0) kill(getpid(), -number);
  errno = number;
  return 1;
}

static int fd_fails(int fd) {
  char link[64], path[PATH_MAX];
  if (!prefix[0]) return 0;
  int before = errno;
  snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
  ssize_t size = readlink(link, path, sizeof path - 1);
  errno = before;
  if (size <= 0 || path[0] != '/') return 0; /* "pipe:[1234]" is on no disk */
  path[size] = 0;
  return path_fails(path);
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

ssize_t write(int fd, const void *data, size_t size) { return fd_fails(fd) ? -1 : REAL(write)(fd, data, size); }
ssize_t writev(int fd, const struct iovec *parts, int n) { return fd_fails(fd) ? -1 : REAL(writev)(fd, parts, n); }
ssize_t pwrite(int fd, const void *data, size_t size, off_t at) {
  return fd_fails(fd) ? -1 : REAL(pwrite)(fd, data, size, at);
}
ssize_t pwrite64(int fd, const void *data, size_t size, off64_t at) {
  return fd_fails(fd) ? -1 : REAL(pwrite64)(fd, data, size, at);
}
ssize_t sendfile(int out, int in, off_t *at, size_t size);
ssize_t sendfile64(int out, int in, off64_t *at, size_t size);
ssize_t sendfile(int out, int in, off_t *at, size_t size) {
  return fd_fails(out) ? -1 : REAL(sendfile)(out, in, at, size);
}
ssize_t sendfile64(int out, int in, off64_t *at, size_t size) {
  return fd_fails(out) ? -1 : REAL(sendfile64)(out, in, at, size);
}
int fsync(int fd) { return fd_fails(fd) ? -1 : REAL(fsync)(fd); }
int fdatasync(int fd) { return fd_fails(fd) ? -1 : REAL(fdatasync)(fd); }
int mkdir(const char *path, mode_t mode) { return path_fails(path) ? -1 : REAL(mkdir)(path, mode); }
int rename(const char *old, const char *new) { return path_fails(new) ? -1 : REAL(rename)(old, new); }

static mode_t read_mode(int flags, va_list rest) { return flags & (O_CREAT | O_TMPFILE) ? va_arg(rest, mode_t) : 0; }

#define OPEN(name)                                                   \
  int name(const char *path, int flags, ...) {                       \
    va_list rest;                                                    \
    va_start(rest, flags);                                           \
    mode_t mode = read_mode(flags, rest);                            \
    va_end(rest);                                                    \
    if ((flags & O_CREAT) && path_fails(path)) return -1;            \
    return REAL(name)(path, flags, mode);                            \
  }
OPEN(open)
OPEN(open64)
