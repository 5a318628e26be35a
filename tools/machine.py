"""A machine on which the documents' lines for root can be typed: a copy of this one, thrown away afterwards.

This machine's root lies under an overlay in memory, and ``systemd-nspawn`` boots it with a systemd, a udev and a
journal of its own; the network is this machine's, so that pip finds what it found outside. What is installed,
enabled or added there is gone when the last process is. It needs root, and writes below /sys as udev does: only where
the environment has ``MACHINE=1``, which ``.ci/run`` sets on machines that are CI's own.
"""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import shutil
import signal
import subprocess
import tempfile
import time
from pathlib import Path

from tools.terminal import WAIT_S, Terminal

NEEDED = ('systemd-nspawn', 'unshare', 'nsenter', 'udevadm', 'ip', 'ssh', 'sshd')
KEPT = re.compile(r'^PIP_|_proxy$|CERT|CA_BUNDLE', re.I)
"""Environment variables that lead to the package index."""

BOOT = """set -e
mount -t tmpfs tmpfs {here}
mkdir {here}/new {here}/work {here}/root
mount -t overlay overlay -o lowerdir=/,upperdir={here}/new,workdir={here}/work {here}/root
rm -f {here}/root/etc/machine-id {here}/root/etc/resolv.conf
cp /etc/resolv.conf {here}/root/etc/resolv.conf
exec systemd-nspawn --quiet --register=no {unit} --console=pipe --link-journal=no --resolv-conf=off \
--capability=CAP_SYS_RESOURCE,CAP_SYS_NICE --bind={checkout}:/root/checkout --bind-ro={environment} \
--directory={here}/root --machine=psd-deflection-docs --boot systemd.unit=basic.target systemd.firstboot=off
"""

SSH_CONFIG = """Host rig
ProxyCommand nsenter --net=/run/netns/rig /usr/sbin/sshd -i
StrictHostKeyChecking accept-new
LogLevel ERROR
"""


def wanted() -> bool:
    """Whether one is to be made here."""
    return os.environ.get('MACHINE') == '1' and os.getuid() == 0


class Machine:
    """It runs from here to :meth:`close`; ``checkout`` is its folder ``/root/checkout``."""

    def __init__(self, checkout: Path, environment: Path) -> None:
        if missing := [name for name in NEEDED if shutil.which(name) is None]:
            raise RuntimeError(f'not found: {", ".join(missing)}')
        self._folder = Path(tempfile.mkdtemp(prefix='psd_deflection_machine_'))
        boot = BOOT.format(
            here=self._folder,
            checkout=checkout,
            environment=environment,
            unit='' if Path('/run/systemd/system').exists() else '--keep-unit',
        )
        self._log = (self._folder.parent / f'{self._folder.name}.log').open('w+b')
        self._nspawn = subprocess.Popen(
            ['unshare', '--mount', '--propagation', 'private', 'bash', '-c', boot],
            env={**os.environ, 'SYSTEMD_NSPAWN_API_VFS_WRITABLE': 'yes'},
            stdin=subprocess.DEVNULL,
            stdout=self._log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        kept = [f'{name}={value}' for name, value in os.environ.items() if KEPT.search(name)]
        self._inside = ['env', '-i', 'HOME=/root', 'USER=root', 'TERM=dumb', *kept]
        self._inside += ['PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin']
        self._environment = environment
        self._init = 0
        try:
            self._wait_until_up()
        except BaseException:
            self.close()
            raise

    def _wait_until_up(self) -> None:
        end = time.monotonic() + WAIT_S
        while time.monotonic() < end and self._nspawn.poll() is None:
            children = Path(f'/proc/{self._nspawn.pid}/task/{self._nspawn.pid}/children').read_text().split()
            for child in children:
                name = ''
                # What prepares the machine comes and goes.
                with contextlib.suppress(OSError):
                    name = Path(f'/proc/{child}/comm').read_text().strip()
                if name == 'systemd':
                    self._init = int(child)
                    # "degraded" is up as well: some unit of the machine that was copied did not like it here.
                    done = subprocess.run(
                        ['bash', '-c', self.typed('systemctl is-system-running --wait || true')],
                        capture_output=True,
                        text=True,
                        timeout=WAIT_S,
                    )
                    if done.stdout.strip() in ('running', 'degraded'):
                        return
            time.sleep(0.2)
        self._log.seek(0)
        raise RuntimeError(f'the machine did not start\n{self._log.read().decode(errors="replace")}')

    def typed(self, line: str, network: str = '') -> str:
        """The line of this machine's shell that runs ``line`` there; ``network``: one that :meth:`tunnel` makes."""
        inside = f'ip netns exec {network} bash -c {shlex.quote(line)}' if network else line
        words = ['nsenter', f'--target={self._init}', '--mount', '--pid', '--uts', '--ipc', *self._inside]
        return shlex.join([*words, 'bash', '-c', f'cd /root/checkout && {inside}'])

    def run(self, line: str) -> str:
        """What ``line`` prints there; RuntimeError where it fails."""
        # There one is root already, and nobody answers "yes".
        line = re.sub(r'\bsudo ', '', re.sub(r'^apt ', 'DEBIAN_FRONTEND=noninteractive apt-get --yes --quiet ', line))
        program = Terminal(self.typed(line), self._folder.parent)
        if (status := program.finish()) != 0:
            raise RuntimeError(f'exit status {status}\n{program.text[-2000:]}')
        return program.text

    def tunnel(self, line: str) -> None:
        """``line`` is an ssh tunnel from a second network there, the reader's, to the monitor on one called rig."""
        self.run('mkdir -p /run/sshd && ip netns add rig && ip netns add reader')
        self.run('ip -n rig link set lo up && ip -n reader link set lo up')
        self.run(
            'mkdir -m 700 -p ~/.ssh && cd ~/.ssh && rm -f id_ed25519 && ssh-keygen -q -t ed25519 -N "" -f id_ed25519 '
            f'&& cp id_ed25519.pub authorized_keys && printf %s {shlex.quote(SSH_CONFIG)} > config'
        )
        monitor = Terminal(self.typed(f'{self._environment}/bin/psd-deflection monitor', 'rig'), self._folder.parent)
        try:
            monitor.until(r'monitor: http://127.0.0.1:8790/')
            ssh = Terminal(self.typed(line, 'reader'), self._folder.parent, stdin=subprocess.PIPE)
            try:
                page = self.run(
                    'ip netns exec reader curl --silent --show-error --retry 300 --retry-connrefused --retry-delay 1 '
                    'http://127.0.0.1:8790/'
                )
            finally:
                if ssh.process.stdin is not None:
                    ssh.process.stdin.close()
                ssh.end()
        finally:
            monitor.end()
        if 'psd_deflection monitor' not in page:
            raise RuntimeError(f'another page came through the tunnel\n{page[:500]}')

    def close(self) -> None:
        """Pull the plug."""
        for process in (self._init, self._nspawn.pid):
            if process and self._nspawn.poll() is None:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(process, signal.SIGKILL)
        self._nspawn.wait()
        Path(self._log.name).unlink()
        self._log.close()
        self._folder.rmdir()


def check_service(machine: Machine) -> None:
    """That the unit, once it runs, is what docs/deploy says: started anew when it hangs or dies, whole when ended."""

    program = '/opt/psd_deflection/bin/psd-deflection'
    recordings = '/var/lib/psd_deflection/recordings'

    def measuring() -> str:
        """Its process, once that has said an estimate and samples are on the disk; '' until then.

        Of one killed within its first half second nothing is.
        """
        pid = machine.run('systemctl show --property MainPID --value psd-deflection').strip()
        if 'θ ' not in machine.run(f'journalctl --no-pager --quiet _PID={pid}'):
            return ''
        newest = machine.run(f'{program} info $(ls -d {recordings}/* | sort --version-sort | tail -1)')
        return pid if re.search(r'samples +[1-9]', newest) else ''

    before = ''
    for blow in ('', 'SIGSTOP', 'SIGKILL'):
        if blow:
            machine.run(f'systemctl kill --kill-whom=main --signal={blow} psd-deflection')
        end = time.monotonic() + WAIT_S
        while (now := measuring()) in ('', before):
            if time.monotonic() > end:
                raise RuntimeError(f'after {blow or "the start"} it did not measure')
            time.sleep(0.5)
        before = now
    if complaint := machine.run('journalctl --no-pager --quiet --unit systemd-udevd --grep psd-deflection || true'):
        raise RuntimeError(f'udev on the rules\n{complaint}')
    if 'Watchdog timeout' not in machine.run('journalctl --no-pager --unit psd-deflection'):
        raise RuntimeError('it was not the watchdog that ended it')
    machine.run('systemctl stop psd-deflection')
    # The first two were cut off by the signals.
    found = machine.run(f'ls -d {recordings}/* | sort --version-sort').split()
    for recording in found[:-1]:
        machine.run(f'{program} recover {recording}')
    for recording in found:
        machine.run(f'{program} replay {recording} --compare')
    if len(found) != 3:
        raise RuntimeError(f'three recordings were wanted, not {found}')
