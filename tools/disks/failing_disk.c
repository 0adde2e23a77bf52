/* A disk that fails, for LD_PRELOAD: stands between a process and the C library's calls that change files.

   Every change of a file or folder below one watched folder is counted, over all processes that have mapped
   the control block named by $FAILING_DISK. The one with the number asked for, and perhaps all later ones,
   fail, are done by half, or kill the process group; or each is written to a journal. See failing_disk.py.

   Not seen: stdio's own writes (fwrite), writes to memory-mapped files, and system calls made directly. */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <sched.h>
#include <signal.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/sendfile.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

enum kind { OPEN, WRITE, TRUNCATE, SYNC, RENAME, UNLINK, MKDIR, RMDIR, LINK, SYMLINK };
enum action { COUNT, FAIL, HALVE, KILL, TEAR };

struct control { /* mirrored by failing_disk.Control */
    uint64_t armed, at, kinds, kinds_after;
    uint32_t action, error;
    atomic_ulong count;
    atomic_uint lock;
    char folder[PATH_MAX], journal[PATH_MAX];
};

struct record { /* mirrored by failing_disk._RECORD; followed by the path, the other path and the bytes */
    uint32_t kind, path_length, other_length, failed;
    int64_t offset;
    uint64_t length;
};

struct change {
    enum kind kind;
    char path[PATH_MAX], other[PATH_MAX];
    int64_t offset;
    size_t length;
    const void *bytes;
    int halved, counted;
};

static struct control *control;

__attribute__((constructor)) static void attach(void) {
    const char *path = getenv("FAILING_DISK");
    int file = path ? (int)syscall(SYS_openat, AT_FDCWD, path, O_RDWR | O_CLOEXEC) : -1;
    if (file < 0) return;
    void *mapped = mmap(NULL, sizeof *control, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
    syscall(SYS_close, file);
    if (mapped != MAP_FAILED) control = mapped;
}

/* Find where `path`, relative to the folder `at`, is; whether that is below the watched folder. */
static int place(char *found, int at, const char *path) {
    char link[64];
    size_t length = 0;
    if (path[0] != '/') {
        if (at == AT_FDCWD) strcpy(link, "/proc/self/cwd");
        else snprintf(link, sizeof link, "/proc/self/fd/%d", at);
        ssize_t read = readlink(link, found, PATH_MAX - 1);
        if (read < 0) return 0;
        length = (size_t)read;
        if (path[0]) found[length++] = '/';
    }
    snprintf(found + length, PATH_MAX - length, "%s", path);
    size_t watched = strlen(control->folder);
    return !strncmp(found, control->folder, watched) && (found[watched] == '/' || !found[watched]);
}

/* Count `change` and act on it: 0 if it is to be done (perhaps `halved`), -1 with errno set if it failed. */
static int decide(struct change *change) {
    uint64_t bit = 1u << change->kind;
    if (!((control->kinds | control->kinds_after) & bit)) return 0;
    uint64_t now = control->kinds & bit ? atomic_fetch_add(&control->count, 1) + 1 : control->count;
    change->counted = 1;
    if (control->action == COUNT) {
        while (atomic_exchange(&control->lock, 1)) sched_yield();
        return 0;
    }
    int is_it = control->kinds & bit && now == control->at;
    if (is_it && control->action == KILL) kill(0, SIGKILL);
    if (is_it && (control->action == HALVE || control->action == TEAR) && change->length > 1) {
        change->halved = 1;
        return 0;
    }
    if (is_it && control->action == TEAR) kill(0, SIGKILL);
    if (is_it || (now >= control->at && control->kinds_after & bit)) {
        errno = (int)control->error;
        return -1;
    }
    return 0;
}

/* Finish `change`, of which `done` came out: kill after half a write, or note it in the journal. */
static void finish(struct change *change, int64_t done) {
    int before = errno;
    if (change->halved && control->action == TEAR) kill(0, SIGKILL);
    if (!change->counted || control->action != COUNT) return;
    if (control->journal[0]) {
        if (change->kind == WRITE) change->length = done < 0 ? 0 : (size_t)done;
        struct record record = {change->kind, (uint32_t)strlen(change->path), (uint32_t)strlen(change->other),
                                done < 0, change->offset, change->kind == WRITE || change->bytes ? change->length : 0};
        void *copy = NULL;
        if (change->kind == WRITE && !change->bytes && change->length) { /* read back what the kernel copied */
            int file = (int)syscall(SYS_openat, AT_FDCWD, change->path, O_RDONLY | O_CLOEXEC);
            change->bytes = copy = malloc(change->length);
            syscall(SYS_pread64, file, copy, change->length, change->offset);
            syscall(SYS_close, file);
        }
        struct iovec parts[] = {{&record, sizeof record},
                                {change->path, record.path_length},
                                {change->other, record.other_length},
                                {(void *)change->bytes, record.length}};
        int file = (int)syscall(SYS_openat, AT_FDCWD, control->journal, O_WRONLY | O_APPEND | O_CLOEXEC);
        syscall(SYS_writev, file, parts, 4);
        syscall(SYS_close, file);
        free(copy);
    }
    atomic_store(&control->lock, 0);
    errno = before;
}

#define NEXT(name) \
    static __typeof__(&name) real; \
    if (!real) real = (__typeof__(&name))dlsym(RTLD_NEXT, #name)

#define IS_WATCHED (control && control->armed)

/* A change of paths: decide, do, finish. */
#define DO(change, call) \
    if (decide(&(change))) return -1; \
    __auto_type result = call; \
    finish(&(change), result < 0 ? -1 : 0); \
    return result

/* Opening a file in order to change it. */

static int changes(int flags) { return (flags & O_ACCMODE) != O_RDONLY || flags & (O_CREAT | O_TRUNC); }

#define OPENING(name, at, ...) \
    NEXT(name); \
    mode_t mode = 0; \
    if (flags & O_CREAT || (flags & O_TMPFILE) == O_TMPFILE) { \
        va_list more; \
        va_start(more, flags); \
        mode = va_arg(more, mode_t); \
        va_end(more); \
    } \
    struct change change = {.kind = OPEN, .offset = !!(flags & O_TRUNC)}; \
    if (!IS_WATCHED || !changes(flags) || !place(change.path, at, path)) return real(__VA_ARGS__, flags, mode); \
    DO(change, real(__VA_ARGS__, flags, mode))

int open(const char *path, int flags, ...) { OPENING(open, AT_FDCWD, path); }
int open64(const char *path, int flags, ...) { OPENING(open64, AT_FDCWD, path); }
int openat(int at, const char *path, int flags, ...) { OPENING(openat, at, at, path); }
int openat64(int at, const char *path, int flags, ...) { OPENING(openat64, at, at, path); }
int creat(const char *path, mode_t mode) { return open(path, O_CREAT | O_WRONLY | O_TRUNC, mode); }
int creat64(const char *path, mode_t mode) { return open64(path, O_CREAT | O_WRONLY | O_TRUNC, mode); }

#define STREAM(name) \
    NEXT(name); \
    struct change change = {.kind = OPEN, .offset = mode[0] == 'w'}; \
    if (!IS_WATCHED || (mode[0] == 'r' && !strchr(mode, '+')) || !place(change.path, AT_FDCWD, path)) \
        return real(path, mode); \
    if (decide(&change)) return NULL; \
    FILE *stream = real(path, mode); \
    finish(&change, stream ? 0 : -1); \
    return stream

FILE *fopen(const char *path, const char *mode) { STREAM(fopen); }
FILE *fopen64(const char *path, const char *mode) { STREAM(fopen64); }

/* Writing. */

static int64_t position(int file) {
    struct stat status;
    if (fcntl(file, F_GETFL) & O_APPEND) return fstat(file, &status) ? 0 : status.st_size;
    return lseek(file, 0, SEEK_CUR);
}

#define WRITING(name, at, count, from, whole, half) \
    NEXT(name); \
    struct change change = {.kind = WRITE, .length = count, .bytes = from}; \
    if (!IS_WATCHED || !place(change.path, file, "")) return whole; \
    change.offset = at; \
    if (decide(&change)) return -1; \
    ssize_t done = change.halved ? half : whole; \
    finish(&change, done); \
    return done

ssize_t write(int file, const void *bytes, size_t size) {
    WRITING(write, position(file), size, bytes, real(file, bytes, size), real(file, bytes, size / 2));
}
ssize_t pwrite(int file, const void *bytes, size_t size, off_t offset) {
    WRITING(pwrite, offset, size, bytes, real(file, bytes, size, offset), real(file, bytes, size / 2, offset));
}
ssize_t pwrite64(int file, const void *bytes, size_t size, off64_t offset) {
    WRITING(pwrite64, offset, size, bytes, real(file, bytes, size, offset), real(file, bytes, size / 2, offset));
}
ssize_t writev(int file, const struct iovec *parts, int count) {
    WRITING(writev, position(file), 2, NULL, real(file, parts, count), real(file, parts, 1));
}
ssize_t pwritev(int file, const struct iovec *parts, int count, off_t offset) {
    WRITING(pwritev, offset, 2, NULL, real(file, parts, count, offset), real(file, parts, 1, offset));
}
ssize_t pwritev64(int file, const struct iovec *parts, int count, off64_t offset) {
    WRITING(pwritev64, offset, 2, NULL, real(file, parts, count, offset), real(file, parts, 1, offset));
}
ssize_t sendfile(int file, int from, off_t *offset, size_t size) {
    WRITING(sendfile, position(file), size, NULL, real(file, from, offset, size), real(file, from, offset, 1));
}
ssize_t sendfile64(int file, int from, off64_t *offset, size_t size) {
    WRITING(sendfile64, position(file), size, NULL, real(file, from, offset, size), real(file, from, offset, 1));
}
ssize_t copy_file_range(int from, off64_t *begin, int file, off64_t *offset, size_t size, unsigned flags) {
    WRITING(copy_file_range, offset ? *offset : position(file), size, NULL,
            real(from, begin, file, offset, size, flags), real(from, begin, file, offset, 1, flags));
}

/* Changes that a file descriptor names. */

#define FILE_CHANGE(name, what, at, failed, ...) \
    NEXT(name); \
    struct change change = {.kind = what, .offset = at}; \
    if (!IS_WATCHED || !place(change.path, file, "")) return real(__VA_ARGS__); \
    if (decide(&change)) return failed; \
    int result = real(__VA_ARGS__); \
    finish(&change, result ? -1 : 0); \
    return result

int ftruncate(int file, off_t size) { FILE_CHANGE(ftruncate, TRUNCATE, size, -1, file, size); }
int ftruncate64(int file, off64_t size) { FILE_CHANGE(ftruncate64, TRUNCATE, size, -1, file, size); }
int fsync(int file) { FILE_CHANGE(fsync, SYNC, 0, -1, file); }
int fdatasync(int file) { FILE_CHANGE(fdatasync, SYNC, 0, -1, file); }
int posix_fallocate(int file, off_t offset, off_t size) {
    FILE_CHANGE(posix_fallocate, TRUNCATE, offset + size, errno, file, offset, size);
}
int posix_fallocate64(int file, off64_t offset, off64_t size) {
    FILE_CHANGE(posix_fallocate64, TRUNCATE, offset + size, errno, file, offset, size);
}

/* Changes that one path names. */

#define PATH_CHANGE(name, what, at, ...) \
    NEXT(name); \
    struct change change = {.kind = what}; \
    if (!IS_WATCHED || !place(change.path, at, path)) return real(__VA_ARGS__); \
    DO(change, real(__VA_ARGS__))

int unlink(const char *path) { PATH_CHANGE(unlink, UNLINK, AT_FDCWD, path); }
int unlinkat(int at, const char *path, int flags) {
    PATH_CHANGE(unlinkat, flags & AT_REMOVEDIR ? RMDIR : UNLINK, at, at, path, flags);
}
int rmdir(const char *path) { PATH_CHANGE(rmdir, RMDIR, AT_FDCWD, path); }
int mkdir(const char *path, mode_t mode) { PATH_CHANGE(mkdir, MKDIR, AT_FDCWD, path, mode); }
int mkdirat(int at, const char *path, mode_t mode) { PATH_CHANGE(mkdirat, MKDIR, at, at, path, mode); }

/* Changes that two paths name; the second is the new one. */

#define TWO_PATHS(name, what, from_at, to_at, ...) \
    NEXT(name); \
    struct change change = {.kind = what}; \
    if (!IS_WATCHED) return real(__VA_ARGS__); \
    int is_from = place(change.path, from_at, path), is_to = place(change.other, to_at, other); \
    if (!is_from && !is_to) return real(__VA_ARGS__); \
    DO(change, real(__VA_ARGS__))

int rename(const char *path, const char *other) { TWO_PATHS(rename, RENAME, AT_FDCWD, AT_FDCWD, path, other); }
int renameat(int from, const char *path, int to, const char *other) {
    TWO_PATHS(renameat, RENAME, from, to, from, path, to, other);
}
int renameat2(int from, const char *path, int to, const char *other, unsigned flags) {
    TWO_PATHS(renameat2, RENAME, from, to, from, path, to, other, flags);
}
int link(const char *path, const char *other) { TWO_PATHS(link, LINK, AT_FDCWD, AT_FDCWD, path, other); }
int linkat(int from, const char *path, int to, const char *other, int flags) {
    TWO_PATHS(linkat, LINK, from, to, from, path, to, other, flags);
}

#define SYMLINKING(name, at, ...) \
    NEXT(name); \
    struct change change = {.kind = SYMLINK}; \
    if (!IS_WATCHED || !place(change.path, at, path)) return real(__VA_ARGS__); \
    snprintf(change.other, sizeof change.other, "%s", target); \
    DO(change, real(__VA_ARGS__))

int symlink(const char *target, const char *path) { SYMLINKING(symlink, AT_FDCWD, target, path); }
int symlinkat(const char *target, int at, const char *path) { SYMLINKING(symlinkat, at, target, at, path); }
